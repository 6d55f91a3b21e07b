"""Attackers of a door, and careless peers: ZMTP by hand, where a client library is too polite.

    python attacks.py ATTACK ENDPOINT SECONDS [KEY]

It says by an empty line that it begins, ends after so many seconds, and prints how many bytes were
taken. In the virtual machine it stands alone.
"""

import contextlib
import itertools
import select
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import msgpack
import zmq

SEND_S = 1.0  # a peer that takes nothing for so long is left
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"


def frame(body: bytes, *, more: bool = False) -> bytes:
    return bytes((more, len(body))) + body


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


BY_HAND: dict[str, Iterable[bytes]] = {  # what each connection sends, and then it leaves
    # more subscriptions than a socket's buffers hold
    "subscribe_and_leave": [b"".join(frame(b"\x01/taxeld/%d" % n) for n in range(4000))],
    # a message whose last frame never comes
    "endless_to_stream": itertools.repeat(frame(b"\x01" * 255, more=True) * 200),
    "unique_subscriptions": (frame(b"\x01" + b"%d" % n * 24) for n in itertools.count()),
}


def shut(endpoint: str) -> Iterator[int]:
    """Subscribers that shut their reading side, or leave, as a message comes."""
    while True:
        yield 0
        with contextlib.suppress(OSError), connected(endpoint) as peer:
            peer.sendall(frame(b"\x01/taxeld/e"))
            select.select([peer], [], [], 1.0)
            peer.sendall(b"\x00")
            peer.shutdown(socket.SHUT_RD)
            time.sleep(0.06)


def requests(endpoint: str) -> Iterator[int]:
    """Requests without end by clients that read the answers."""
    context, request = zmq.Context(), msgpack.packb({"cmd": "status"})
    sockets = [context.socket(zmq.DEALER) for _ in range(8)]
    for each in sockets:
        each.connect(endpoint)
    for each in itertools.cycle(sockets):
        yield 0
        with contextlib.suppress(zmq.Again):
            each.send_multipart([b"", request], zmq.NOBLOCK)
            while each.poll(0):
                each.recv_multipart(zmq.NOBLOCK)


def nonsense(endpoint: str) -> Iterator[int]:
    """What is no ZeroMQ, on the robot's port."""
    port = int(endpoint.rpartition(":")[2])
    listens = socket.create_server(("127.0.0.1", port), reuse_port=False)
    yield 0
    peer, _ = listens.accept()
    peer.sendall(b"\xff" * 200)
    while True:
        time.sleep(0.1)
        yield 0


def strange_keys(endpoint: str, server: str) -> Iterator[int]:
    """Handshakes with keys that nobody knows, without end; `server`: its public key."""
    context: zmq.Context[Any] = zmq.Context()
    while True:
        yield 0
        with contextlib.ExitStack() as opened:
            for _ in range(20):
                made = opened.enter_context(context.socket(zmq.SUB))
                made.setsockopt(zmq.LINGER, 0)
                made.curve_serverkey = server.encode()
                made.curve_publickey, made.curve_secretkey = zmq.curve_keypair()
                made.connect(endpoint)
            made.poll(50)


def by_hand(name: str, endpoint: str) -> Iterator[int]:
    while True:
        yield 0
        with contextlib.suppress(OSError), connected(endpoint) as peer:
            for data in BY_HAND[name]:
                yield peer.send(data)


ATTACKS: dict[str, Callable[..., Iterator[int]]] = {
    each.__name__: each for each in (shut, requests, nonsense, strange_keys)
}

if __name__ == "__main__":
    name, where, seconds, *more = sys.argv[1:]
    attack = ATTACKS[name](where, *more) if name in ATTACKS else by_hand(name, where)
    until_s, total = time.monotonic() + float(seconds), next(attack)
    print(flush=True)
    for taken in attack:
        total += taken
        if time.monotonic() > until_s:
            break
    print(total)
