"""Endpoints, bound: no daemon takes the socket file of another that lives."""

import contextlib
import errno
import os
import socket as kernel
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zmq

from taxeld.config import endpoints
from taxeld.errors import SetupError
from taxeld.stream.sockets import why

PROBE_S = 1.0
OPEN_TO = 0o117  # umask of a socket file: owner and group may connect
CURES = {  # of a TCP address
    errno.EADDRINUSE: "'ss -tlnp' tells which program has the port",
    errno.EADDRNOTAVAIL: "'ip address' lists this machine's addresses",
    errno.ENODEV: "'ip address' lists this machine's addresses",
}


class NotNowError(SetupError):
    """The endpoint cannot be had now, and may be had later."""


@contextlib.contextmanager
def bound(socket: zmq.Socket[Any], endpoint: str, key: str) -> Iterator[Callable[[], bool]]:
    """Meanwhile `socket` serves whoever comes to the endpoint; → whether newcomers still can: its
    socket file, if it has one, may be removed. `key` names it in the configuration. Where the file
    was removed, the same socket may be bound once more, and keeps its peers.

    Raises:
        NotNowError: another process has it, or this machine lacks the TCP address.
        SetupError: it cannot be bound at all.
    """
    path = endpoints.ipc_path(endpoint)
    if path is not None:
        _make_way(endpoint, path, key)
    socket.setsockopt(zmq.IPV6, "[" in endpoint)
    before = os.umask(OPEN_TO)
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        line = f"{key}: cannot bind {endpoint} ({why(error)})"
        if path is None and error.errno in CURES:
            raise NotNowError(f"{line}; {CURES[error.errno]}") from None
        raise SetupError(
            f"{line}; is another daemon there? stop it or name another endpoint"
        ) from None
    finally:
        os.umask(before)
    made = path and _identity(path)
    try:
        yield lambda: path is None or _identity(path) == made
    finally:
        if path is not None and _identity(path) == made:
            path.unlink()  # ZeroMQ leaves it


def _identity(path: Path) -> tuple[int, int] | None:
    """Of a socket file; None where there is none. The number of a removed file is given anew."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


def _make_way(endpoint: str, path: Path, key: str) -> None:
    """Leave `path` to be bound, unless it is a living daemon's: ZeroMQ would remove any file."""
    missing = endpoints.no_directory(endpoint)
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
            return
        except OSError as error:
            raise SetupError(f"{key}: cannot take over {path} ({error.strerror})") from None
    raise NotNowError(f"{key}: another daemon serves {path}; stop it or name another endpoint")
