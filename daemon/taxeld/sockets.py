"""What all sockets share: options, binding, and reading a bounded number of frames a tick."""

import os
import socket as unix
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import zmq

from taxeld import endpoints
from taxeld.errors import SetupError

HEARTBEAT_MS = 1000
DEAD_MS = 5000  # a peer that is silent for so long is let go, and its queue with it
PROBE_S = 1.0


def open_socket(
    context: zmq.Context[Any], kind: int, *, send: int, receive: int, largest: int
) -> zmq.Socket[Any]:
    """A socket that keeps `send` and `receive` messages a peer, and hangs up on one that sends a
    frame of more than `largest` bytes."""
    socket: zmq.Socket[Any] = context.socket(kind)
    for option, value in (
        (zmq.LINGER, 0),
        (zmq.SNDHWM, send),
        (zmq.RCVHWM, receive),
        (zmq.MAXMSGSIZE, largest),
        (zmq.HEARTBEAT_IVL, HEARTBEAT_MS),
        (zmq.HEARTBEAT_TIMEOUT, DEAD_MS),
    ):
        socket.setsockopt(option, value)
    return socket


def bind(socket: zmq.Socket[Any], endpoint: str, key: str) -> None:
    """Bind; an ipc socket is open to owner and group, and a stale one is replaced.

    Raises:
        SetupError: the endpoint is taken, or cannot be had.
    """
    path = endpoints.ipc_path(endpoint)
    if path is not None:
        _make_way(path, key)
    socket.setsockopt(zmq.IPV6, "[" in endpoint)
    before = os.umask(0o117)  # 0660 from the first moment on
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        raise SetupError(
            f"{key}: cannot bind {endpoint} ({_why(error)}); "
            "is another daemon there? stop it or name another endpoint"
        ) from None
    finally:
        os.umask(before)


def connect(socket: zmq.Socket[Any], endpoint: str, key: str) -> None:
    """Raises SetupError where the endpoint is none."""
    socket.setsockopt(zmq.IPV6, "[" in endpoint)
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        raise SetupError(f"{key}: cannot use {endpoint} ({_why(error)})") from None


def unpack(body: bytes) -> dict[str, Any]:
    """A msgpack map, or an empty one for anything else."""
    try:
        value = msgpack.unpackb(body)
    except (ValueError, msgpack.UnpackException):
        return {}
    return value if isinstance(value, dict) else {}


class Inbox:
    """The messages of a socket, by their frames: one of very many cannot hold a tick."""

    def __init__(self, socket: zmq.Socket[Any], most_parts: int) -> None:
        self._socket = socket
        self._most = most_parts
        self._parts: list[bytes] = []

    def take(self, frames: int) -> Iterator[list[bytes]]:
        """The messages that end within the next `frames` frames; one of more than `most_parts` is
        cut to one part more than that."""
        for _ in range(frames):
            # cheaper than an exception; a message comes whole
            if not self._parts and not int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                return
            frame = self._socket.recv(zmq.NOBLOCK)
            if len(self._parts) <= self._most:
                self._parts.append(frame)
            if not self._socket.getsockopt(zmq.RCVMORE):
                whole, self._parts = self._parts, []
                yield whole


def _why(error: zmq.ZMQError) -> str:
    return str(error.strerror).partition(" (addr=")[0]  # the endpoint is named already


def _make_way(path: Path, key: str) -> None:
    """Leave `path` to be bound: ZeroMQ would take a living daemon's socket from it unasked."""
    missing = endpoints.no_directory(f"{endpoints.IPC}{path}")
    if missing:
        raise SetupError(f"{key}: {missing}")
    if not os.path.lexists(path):
        return
    if not path.is_socket():
        raise SetupError(f"{key}: {path} is no socket; remove it or name another endpoint")
    with unix.socket(unix.AF_UNIX) as probe:
        probe.settimeout(PROBE_S)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return  # left behind by a process that is gone
        except OSError as error:
            raise SetupError(f"{key}: cannot take over {path} ({error.strerror})") from None
    raise SetupError(f"{key}: another daemon serves {path}; stop it or name another endpoint")
