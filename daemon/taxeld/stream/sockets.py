"""What all sockets of ZeroMQ's share: options, and who is at the other end."""

import errno
import os
import socket as kernel
import struct
from typing import Any

import msgpack
import zmq

from taxeld.errors import SetupError

HANDSHAKE_MS = 5000  # a peer that has not said who it is by then is let go
CREDENTIALS = struct.Struct("3i")
KEEPALIVE_S = 10  # the kernel asks a silent peer beyond this machine, and lets a dead one go
KEEPALIVE_TRIES = 3
# as plain numbers: pyzmq takes long over its enumerations
EVENTS, WAITING = int(zmq.EVENTS), int(zmq.POLLIN)


def open_socket(
    context: zmq.Context[Any], kind: int, *, send: int, receive: int, largest: int
) -> zmq.Socket[Any]:
    """A socket that keeps `send` and `receive` messages a peer, and hangs up on one that sends a
    frame of more than `largest` bytes.

    There are no heartbeats: in libzmq 4.3.5 a peer that floods and leaves has their timer abort
    the process.
    """
    socket: zmq.Socket[Any] = context.socket(kind)
    for option, value in (
        (zmq.LINGER, 0),
        (zmq.SNDHWM, send),
        (zmq.RCVHWM, receive),
        (zmq.MAXMSGSIZE, largest),
        (zmq.HANDSHAKE_IVL, HANDSHAKE_MS),
        (zmq.TCP_KEEPALIVE, 1),
        (zmq.TCP_KEEPALIVE_IDLE, KEEPALIVE_S),
        (zmq.TCP_KEEPALIVE_INTVL, KEEPALIVE_S),
        (zmq.TCP_KEEPALIVE_CNT, KEEPALIVE_TRIES),
    ):
        socket.setsockopt(option, value)
    return socket


def connect(socket: zmq.Socket[Any], endpoint: str, key: str) -> None:
    """Raises SetupError where the endpoint is none."""
    socket.setsockopt(zmq.IPV6, "[" in endpoint)
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        raise SetupError(f"{key}: cannot use {endpoint} ({why(error)})") from None


def why(error: zmq.ZMQError) -> str:
    return str(error.strerror).partition(" (addr=")[0]  # the endpoint is named already


def unpack(body: bytes) -> dict[str, Any]:
    """A msgpack map, or an empty one for anything else."""
    try:
        value = msgpack.unpackb(body)
    except (ValueError, msgpack.UnpackException):
        return {}
    return value if isinstance(value, dict) else {}


def is_waiting(socket: zmq.Socket[Any]) -> bool:
    """Whether there is something to receive; cheaper than an exception."""
    return bool(int(socket.get(EVENTS)) & WAITING)


def connection_of(frame: zmq.Frame) -> int | None:
    """The descriptor of the connection that `frame` came by; None where ZeroMQ made it itself."""
    try:
        return int(frame.get(zmq.SRCFD))
    except zmq.ZMQError:
        return None


def sender(frame: zmq.Frame) -> kernel.socket:
    """The connection of the peer that sent `frame`, to be closed without closing ZeroMQ's own.

    Raises:
        OSError: ZeroMQ has closed it, and its number may be another connection's by now.
    """
    number = connection_of(frame)
    if number is None:
        raise OSError(errno.ENOTCONN, "ZeroMQ's own")
    connection = borrowed(number)
    try:
        if str(frame.get("Peer-Address")) != _peer(connection):
            raise OSError(errno.ENOTCONN, "another connection")
    except OSError:
        connection.close()
        raise
    return connection


def borrowed(number: int) -> kernel.socket:
    """The kernel's socket of a descriptor that is ZeroMQ's, to be closed without closing that.

    Raises:
        OSError: it is none.
    """
    copy = os.dup(number)
    try:
        return kernel.socket(fileno=copy)
    except OSError:
        os.close(copy)
        raise


def _peer(connection: kernel.socket) -> str:
    """Who is at the other end, as ZeroMQ writes it."""
    if connection.family != kernel.AF_UNIX:
        return str(connection.getpeername()[0])
    pid, uid, gid = credentials(connection)
    return f"localhost:{uid}:{gid}:{pid}"


def credentials(connection: kernel.socket) -> tuple[int, int, int]:
    """Process, user and group at the other end of a Unix socket, when it connected."""
    packed = connection.getsockopt(kernel.SOL_SOCKET, kernel.SO_PEERCRED, CREDENTIALS.size)
    pid, uid, gid = CREDENTIALS.unpack(packed)
    return pid, uid, gid
