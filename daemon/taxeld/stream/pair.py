"""The packets between the loop and a door, on one SOCK_SEQPACKET pair.

A packet is one msgpack array: its kind, and its values. To the door:

    MESSAGE  topic, Unix time of the measurement, packed map
    STATE    map: the part of the answer to `status` that no message has
    MEMORY   the scans that the belief has learned from, as a file of numpy's
    ANSWER   number of the request, why it was not done; empty: it was done
    ASK      poses are wanted now: those that have come, and, if true, the next one as well

To the loop:

    READY    the door serves
    FAULT    a line: an endpoint or a key cannot be used, and the door ends
    WANTED   the topics that somebody has subscribed to
    POSES    each link's sensor's poses [t, x, y, theta]; whether they answer ASK; Unix time at
             which they came
    CHANGE   number of the request, its command, and a map of its arguments
    ARRAY    t, id, counts at rest, counts
    REPORT   map: what the door counts, once a second
    LOG      level, a line

A packet that is too large goes as a file in memory, by its descriptor; so do the scans of MEMORY.
"""

import os
import socket
import sys
from enum import IntEnum
from typing import Any

import msgpack

PACKET_MAX = 65_536  # bytes
BESIDE = socket.CMSG_LEN(4)  # one descriptor
PACK = msgpack.Packer().pack
TEXT_MAX = 500  # characters of a line


class Kind(IntEnum):
    """The first value of a packet."""

    MESSAGE = 1
    STATE = 2
    ANSWER = 3
    ASK = 4
    MEMORY = 5
    READY = 16
    FAULT = 17
    WANTED = 18
    POSES = 19
    CHANGE = 20
    REPORT = 21
    LOG = 22
    ARRAY = 23


def open_pair() -> tuple[socket.socket, socket.socket]:
    """The loop's end and the door's; both do not block."""
    loop, door = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    loop.setblocking(False)
    door.setblocking(False)
    return loop, door


def send(end: socket.socket, kind: Kind, *values: object, file: int | None = None) -> bool:
    """Whether the packet went out; never waits. The content of an open `file` is one value more.

    Raises:
        OSError: the other end is gone, or no descriptor is left.
    """
    packet: bytes = PACK([int(kind), *values])
    try:
        if file is not None:
            socket.send_fds(end, [packet], [file])
        elif len(packet) <= PACKET_MAX:
            end.send(packet)
        else:
            with os.fdopen(os.memfd_create("taxeld"), "wb") as large:
                large.write(packet)
                large.flush()
                socket.send_fds(end, [b"\xc0"], [large.fileno()])
    except BlockingIOError:
        return False
    return True


def receive(end: socket.socket) -> tuple[int, list[Any]] | None:
    """Kind and values of the next packet; None: none is there.

    Raises:
        EOFError: the other end is gone.
        ConnectionResetError: it has left without reading; what it sent before comes next.
        ValueError: it is no packet.
    """
    try:
        data, beside, _, _ = end.recvmsg(PACKET_MAX, BESIDE)
    except BlockingIOError:
        return None
    if not data:
        raise EOFError
    packet = msgpack.unpackb(data)
    if beside:
        with os.fdopen(int.from_bytes(beside[0][2], sys.byteorder), "rb") as reader:
            reader.seek(0)
            content = reader.read()
        packet = msgpack.unpackb(content) if packet is None else [*packet, content]
    kind, *values = packet
    return kind, values


def printable(text: str) -> str:
    """One line of at most TEXT_MAX characters, whatever a peer has sent."""
    text = text[:TEXT_MAX]
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
