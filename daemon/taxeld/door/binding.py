"""Endpoints, bound: a socket file belongs to the daemon, and goes with it."""

import errno
import os
import socket as kernel
from pathlib import Path
from typing import Any

import zmq

from taxeld.config import endpoints
from taxeld.errors import SetupError
from taxeld.stream.sockets import why

BACKLOG = 128
PROBE_S = 1.0
ABSENT = "'ip address' lists this machine's addresses"
LATER = {  # a TCP address that may be bound later → how to find out
    errno.EADDRINUSE: "'ss -tlnp' tells which program has the port",
    errno.EADDRNOTAVAIL: ABSENT,
    errno.ENODEV: ABSENT,  # an interface that is not there, or has no address yet
}


class NotNowError(SetupError):
    """The endpoint cannot be had now, and may be had later."""


class Binding:
    """An endpoint that is served by a socket of ZeroMQ's.

    The file of an ipc endpoint is made and removed here. ZeroMQ would take the file of a living
    daemon, and would remove one later on when another daemon's may stand there.
    """

    def __init__(self, endpoint: str, key: str) -> None:
        """Raises SetupError, in the name of `key`, where the endpoint is taken or cannot be had."""
        self._endpoint = endpoint
        self._key = key
        self.name = f"{key}: {endpoint}"
        self._path = endpoints.ipc_path(endpoint)
        self._listening: kernel.socket | None = None  # listening socket of an ipc endpoint
        self._file: tuple[int, int] | None = None
        if self._path is not None:
            make_way(self._path, key)
            try:
                self._listen(self._path)
            except OSError as error:
                raise self._fault(str(error.strerror)) from None

    def let_in(self, socket: zmq.Socket[Any]) -> None:
        """Have `socket` serve whoever comes.

        Raises:
            NotNowError: somebody else has the TCP address, or this machine lacks it.
            SetupError: it cannot be bound at all.
        """
        socket.setsockopt(zmq.IPV6, "[" in self._endpoint)
        if self._listening is not None:
            socket.setsockopt(zmq.USE_FD, os.dup(self._listening.fileno()))
        try:
            socket.bind(self._endpoint)
        except zmq.ZMQError as error:
            raise self._fault(why(error), LATER.get(error.errno or 0, "")) from None
        finally:
            socket.setsockopt(zmq.USE_FD, -1)

    def close(self) -> None:
        if self._listening is not None and self._path is not None:
            self._listening.close()
            if _identity(self._path) == self._file:
                self._path.unlink(missing_ok=True)

    def _listen(self, path: Path) -> None:
        """Make the file, open to owner and group."""
        made = kernel.socket(kernel.AF_UNIX)
        before = os.umask(0o117)  # 0660 from the first moment on
        try:
            made.bind(str(path))
        except OSError:
            made.close()
            raise
        finally:
            os.umask(before)
        made.setblocking(False)
        made.listen(BACKLOG)
        self._listening, self._file = made, _identity(path)

    def _fault(self, reason: str, later: str = "") -> SetupError:
        line = f"{self._key}: cannot bind {self._endpoint} ({reason}); "
        if later:
            return NotNowError(line + later)
        return SetupError(line + "is another daemon there? stop it or name another endpoint")


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of the file itself; None where there is none."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def make_way(path: Path, key: str) -> None:
    """Leave `path` to be bound, unless it is a living daemon's."""
    missing = endpoints.no_directory(f"{endpoints.IPC}{path}")
    if missing:
        raise SetupError(f"{key}: {missing}")
    if not os.path.lexists(path):
        return
    if not path.is_socket():
        raise SetupError(f"{key}: {path} is no socket; remove it or name another endpoint")
    with kernel.socket(kernel.AF_UNIX) as probe:
        probe.settimeout(PROBE_S)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:  # left behind by a process that is gone
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise SetupError(f"{key}: cannot remove {path} ({error.strerror})") from None
            return
        except OSError as error:
            raise SetupError(f"{key}: cannot take over {path} ({error.strerror})") from None
    raise NotNowError(f"{key}: another daemon serves {path}; stop it or name another endpoint")
