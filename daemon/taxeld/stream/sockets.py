"""What all sockets of ZeroMQ's share: their options, connections, and maps that are received."""

from typing import Any

import msgpack
import zmq

from taxeld.errors import SetupError

HANDSHAKE_MS = 5000  # a peer that has not said who it is by then is let go
KEEPALIVE_S = 10  # the kernel asks a silent peer beyond this machine, and lets a dead one go
KEEPALIVE_TRIES = 3
# as plain numbers: pyzmq takes long over its enumerations
EVENTS, WAITING = int(zmq.EVENTS), int(zmq.POLLIN)
NOBLOCK, MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)


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
