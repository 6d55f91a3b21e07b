"""The packets between the loop and the door, on one SOCK_SEQPACKET pair.

A packet is one byte for its kind, and a body. To the door:

    MESSAGE  topic's number (1 byte), Unix time of the measurement (double), msgpack map
    STATE    msgpack map: the part of the answer to `status` that no message has
    MEMORY   the scans that the belief has learned from, as a file of numpy's
    ANSWER   number of the request (4 bytes), a text; empty: it was done
    ASK      poses are wanted now: those that have come (0), and the next one as well (1)

To the loop:

    READY    the door serves
    FAULT    a line: an endpoint or a key cannot be used, and the door ends
    WANTED   a bit for each topic that somebody has subscribed to (1 byte)
    POSES    t, x, y, theta of the sensor (4 doubles), once or more
    POSES_OF number of a further link (1 byte), and its sensor's poses
    CHANGE   number of the request (4 bytes), and its command
    ARRAY    t, counts at rest, length of the id (12 bytes), id, counts (2 bytes each)
    PRIOR    number of the request (4 bytes), x, y, theta, cov, weight (13 doubles), object's name
    REPORT   msgpack map: what the door counts, once a second
    LOG      severity (1 byte), a line

A body that is too large for a packet goes to the door as a file in memory, by its descriptor.
"""

import contextlib
import os
import socket
import struct
from enum import IntEnum

from taxeld.prior import PosePrior
from taxeld_protocol.array import ArrayFrame

SO_PASSRIGHTS = 83  # Linux 6.16
PACKET_MAX = 65_536  # bytes, kind and body
HEAD = struct.Struct("=Bd")  # head of a MESSAGE: topic's number, time
POSE = struct.Struct("=4d")
POSES_MAX = 100  # poses in a packet
REQUEST = struct.Struct("=I")  # number of a request
PRIOR = struct.Struct("=I13d")  # head of a PRIOR
ARRAY = struct.Struct("=dHH")  # head of an ARRAY: time, counts at rest, bytes of the id


class Kind(IntEnum):
    """The first byte of a packet."""

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
    POSES_OF = 24
    PRIOR = 25


def pack_array(frame: ArrayFrame) -> bytes:
    """The body of an ARRAY."""
    name = frame.id.encode()
    counts = struct.pack(f"={len(frame.counts)}H", *frame.counts)
    return ARRAY.pack(frame.t, frame.rest, len(name)) + name + counts


def unpack_array(body: bytes) -> ArrayFrame:
    """Raises ValueError or struct.error where it is none."""
    t, rest, size = ARRAY.unpack_from(body)
    begin = ARRAY.size + size
    counts = struct.unpack(f"={(len(body) - begin) // 2}H", body[begin:])
    return ArrayFrame(t, body[ARRAY.size : begin].decode(), rest, counts)


def pack_prior(pose: PosePrior, number: int) -> bytes:
    """The body of a PRIOR of request `number`."""
    values = pose.x, pose.y, pose.theta, *pose.cov, pose.weight
    return PRIOR.pack(number, *values) + pose.object.encode()


def unpack_prior(body: bytes) -> tuple[int, PosePrior]:
    """Number and prior. Raises ValueError or struct.error where it is none."""
    number, x, y, theta, *cov, weight = PRIOR.unpack_from(body)
    pose = PosePrior(x, y, theta, tuple(cov), weight, body[PRIOR.size :].decode())
    if pose.fault:
        raise ValueError(pose.fault)
    return number, pose


def open_pair() -> tuple[socket.socket, socket.socket]:
    """The loop's end and the door's; both do not block.

    A kernel that can (Linux 6.16) refuses descriptors that the door would send to the loop: to
    close a socket with a linger time, unasked, would stop the loop for that long.
    """
    loop, door = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    loop.setblocking(False)
    door.setblocking(False)
    refuse_descriptors(loop)
    return loop, door


def refuse_descriptors(receiver: socket.socket) -> None:
    """Let nobody pass descriptors to `receiver`, or to what it accepts, where the kernel can."""
    with contextlib.suppress(OSError):
        receiver.setsockopt(socket.SOL_SOCKET, SO_PASSRIGHTS, 0)


def send(end: socket.socket, kind: Kind, body: bytes) -> bool:
    """Whether the packet went out; never waits.

    Raises:
        OSError: the other end is gone.
    """
    try:
        end.send(bytes((kind,)) + body)
    except BlockingIOError:
        return False
    return True


def send_large(end: socket.socket, kind: Kind, body: bytes) -> bool:
    """The same for a body of any size, which goes in a file in memory.

    Raises:
        OSError: the other end is gone, or no descriptor is left.
    """
    file = os.memfd_create("taxeld", os.MFD_CLOEXEC)
    try:
        with os.fdopen(os.dup(file), "wb") as writer:
            writer.write(body)
        socket.send_fds(end, [bytes((kind,))], [file])
    except BlockingIOError:
        return False
    finally:
        os.close(file)
    return True


def receive(end: socket.socket) -> tuple[int, bytes] | None:
    """Kind and body of the next packet, for the door, which trusts the loop; None: none is there.

    Raises:
        EOFError: the loop is gone.
    """
    try:
        data, files, _, _ = socket.recv_fds(end, PACKET_MAX, 1)
    except BlockingIOError:
        return None
    if not data:
        raise EOFError
    if not files:
        return data[0], data[1:]
    with os.fdopen(files[0], "rb") as reader:
        reader.seek(0)
        return data[0], reader.read()
