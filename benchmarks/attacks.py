"""What a hostile neighbour sends: ZMTP by hand, as a client library is too polite.

    python benchmarks/attacks.py ATTACK ENDPOINT SECONDS COUNT

Each attack ends after so many seconds and so many connections, messages or megabytes, whichever
comes first, and prints what it has done. Endpoints are ipc or 127.0.0.1 alone.
"""

import contextlib
import itertools
import json
import os
import resource
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable

SEND_S = 1.0  # a peer that takes nothing for so long is left
OWN_FILES = 64  # descriptors
STAY_S = 3.0  # of a crowd that is all there
BATCH = 40  # connections at a time
SUBSCRIPTIONS = 4000  # of each, more than a socket's buffers hold
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
STATUS, TARE = b"\x81\xa3cmd\xa6status", b"\x81\xa3cmd\xa4tare"  # msgpack of {"cmd": …}
IPC, TCP = "ipc://", "tcp://127.0.0.1:"
Clock = Callable[[], bool]  # whether there is time left


def frame(body: bytes, *, more: bool = False) -> bytes:
    if len(body) < 256:
        return struct.pack("BB", more, len(body)) + body
    return struct.pack(">BQ", more | 2, len(body)) + body


def question(body: bytes) -> bytes:
    """A request as REQ sends it: an empty frame before it."""
    return frame(b"", more=True) + frame(body)


class Peer:
    """A connection that is greeted as ZeroMQ's are, and whose answers nobody reads."""

    def __init__(self, endpoint: str, kind: bytes = b"SUB", *, waits: bool = True) -> None:
        """`waits`: until it is greeted; ZeroMQ cuts off who sends much before."""
        if endpoint.startswith(IPC):
            self._socket = socket.socket(socket.AF_UNIX)
            address: object = endpoint.removeprefix(IPC)
        else:
            self._socket = socket.socket(socket.AF_INET)
            address = "127.0.0.1", int(endpoint.removeprefix(TCP))
        self._socket.settimeout(SEND_S)
        named = b"\x05READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
        try:
            self._socket.connect(address)
            self._socket.sendall(GREETING)
            heard = self._socket.recv(len(GREETING)) if waits else b""
            self._socket.sendall(struct.pack("BB", 4, len(named)) + named)
            while waits and b"READY" not in heard:
                more = self._socket.recv(256)
                if not more:
                    raise ConnectionResetError
                heard += more
        except OSError:
            self._socket.close()
            raise

    def send(self, data: bytes) -> int:
        """→ the bytes that were taken: not all of them where the other end has had enough."""
        sent = 0
        with contextlib.suppress(OSError):
            while sent < len(data):
                sent += self._socket.send(data[sent : sent + 65536])
        return sent

    def close(self) -> None:
        self._socket.close()


def come_and_go(endpoint: str, on: Clock, count: int, kind: bytes, data: bytes) -> Counter[str]:
    """Connections that each send a lot and leave, many at a time."""
    done: Counter[str] = Counter()
    while on() and done["connections"] < count:
        peers: list[Peer] = []
        with contextlib.suppress(OSError):
            for _ in range(min(BATCH, count - done["connections"])):
                peers.append(Peer(endpoint, kind))  # noqa: PERF401  (those before one that fails)
        for peer in peers:
            peer._socket.setblocking(False)
            done["bytes"] += peer.send(data)
        for peer in peers:
            peer.close()
        done["connections"] += len(peers)
        if not peers:
            done["refused"] += 1
            time.sleep(0.05)
    return done


def subscribe_and_leave(endpoint: str, on: Clock, count: int) -> Counter[str]:
    many = b"".join(frame(b"\x01/taxeld/%d" % n) for n in range(SUBSCRIPTIONS))
    return come_and_go(endpoint, on, count, b"SUB", many)


def ask_and_leave(endpoint: str, on: Clock, count: int) -> Counter[str]:
    return come_and_go(endpoint, on, count, b"REQ", question(STATUS) * SUBSCRIPTIONS)


def flood_and_exit(endpoint: str, on: Clock, count: int) -> Counter[str]:
    """A client of pyzmq's that asks without end and ends in the middle of it."""
    import zmq  # noqa: PLC0415  (the others do without)

    asking = zmq.Context().socket(zmq.DEALER)
    asking.connect(endpoint)
    done: Counter[str] = Counter()
    while on() and done["messages"] < count:
        try:
            asking.send_multipart([b"", STATUS], zmq.NOBLOCK)
            done["messages"] += 1
        except zmq.Again:
            time.sleep(0.001)
    print(json.dumps(done), flush=True)
    os._exit(0)


def allow_files(count: int) -> int:
    """→ how many connections this process may hold, `count` at most."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = min(hard, count + OWN_FILES)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    return most - OWN_FILES


def crowd(endpoint: str, on: Clock, count: int) -> Counter[str]:
    """Every other one subscribes and leaves; the rest stay, and say nothing more."""
    done: Counter[str] = Counter()
    stay = allow_files(count // 2)
    held = []
    while on() and done["connections"] < count:
        try:
            peer = Peer(endpoint)
        except OSError:
            done["refused"] += 1
            time.sleep(0.01)
            continue
        done["connections"] += 1
        if done["connections"] % 2 and len(held) < stay:
            held.append(peer)
        else:
            done["bytes"] += peer.send(frame(b"\x01/taxeld/"))
            peer.close()
    done["held"] = len(held)
    until_s = time.monotonic() + STAY_S
    while on() and time.monotonic() < until_s:
        time.sleep(0.01)
    return done


def idle(endpoint: str, on: Clock, count: int) -> Counter[str]:
    """Connections that are held and say nothing more."""
    done: Counter[str] = Counter()
    allow_files(count)
    peers = []
    while on() and len(peers) < count:
        try:
            peers.append(Peer(endpoint, waits=False))
        except OSError:
            done["refused"] += 1
            time.sleep(0.01)
    while on():
        time.sleep(0.01)
    done["connections"] = len(peers)
    return done


def stream(endpoint: str, on: Clock, count: int, kind: bytes, data: Callable[[], bytes]) -> Counter:
    """`data` again and again, up to `count` MB; a connection that is cut is made anew."""
    done: Counter[str] = Counter()
    while on() and done["bytes"] < count * 1_000_000:
        try:
            peer = Peer(endpoint, kind)
        except OSError:
            done["refused"] += 1
            time.sleep(0.05)
            continue
        done["connections"] += 1
        while on() and done["bytes"] < count * 1_000_000:
            block = data()
            sent = peer.send(block)
            done["bytes"] += sent
            if sent < len(block):
                break
        peer.close()
    return done


def endless_to_stream(endpoint: str, on: Clock, count: int) -> Counter[str]:
    """A message whose last frame never comes."""
    block = frame(b"x" * 1000, more=True) * 60
    return stream(endpoint, on, count, b"SUB", lambda: block)


def endless_to_control(endpoint: str, on: Clock, count: int) -> Counter[str]:
    block = frame(b"x" * 4000, more=True) * 15
    return stream(endpoint, on, count, b"DEALER", lambda: block)


def unique_subscriptions(endpoint: str, on: Clock, count: int) -> Counter[str]:
    """Subscriptions to topics that nobody has, each another one."""
    numbers = itertools.count()

    def block() -> bytes:
        return b"".join(frame(b"\x01" + b"%d" % next(numbers) * 24) for _ in range(200))

    return stream(endpoint, on, count, b"SUB", block)


def stranger(endpoint: str, on: Clock, count: int) -> Counter[str]:
    """Ends of subscriptions that were never begun, and what is neither."""
    topics = b"taxels", b"particles", b"estimate", b""
    said = b"".join(
        frame(first + b"/taxeld/" + topic) for topic in topics for first in (b"\x02", b"\x00")
    )
    said += frame(b"\x02") + frame(b"\x00") + frame(b"")
    done: Counter[str] = Counter()
    peer = Peer(endpoint)
    while on() and done["messages"] < count:
        if not peer.send(said):
            break
        done["messages"] += 1
        time.sleep(0.05)
    return done


def many_frames(endpoint: str, on: Clock, count: int) -> Counter[str]:
    """One request of `count` frames of a byte."""
    peer = Peer(endpoint, b"DEALER")
    block, done = frame(b"x", more=True) * 1000, Counter[str]()
    for _ in range(count // 1000):
        done["bytes"] += peer.send(block)
    done["bytes"] += peer.send(frame(b"x"))
    while on():  # one who leaves takes with it what was not read yet
        time.sleep(0.01)
    return done


def tare(endpoint: str, on: Clock, count: int) -> Counter[str]:
    """`tare`, again and again."""
    peer, done = Peer(endpoint, b"DEALER"), Counter[str]()
    while on() and done["messages"] < count and peer.send(question(TARE)):
        done["messages"] += 1
        time.sleep(0.02)
    return done


ATTACKS = {
    made.__name__: made
    for made in (
        subscribe_and_leave,
        ask_and_leave,
        flood_and_exit,
        crowd,
        idle,
        endless_to_stream,
        endless_to_control,
        unique_subscriptions,
        stranger,
        many_frames,
        tare,
    )
}


def main() -> int:
    name, endpoint, seconds, count = sys.argv[1:]
    until_s = time.monotonic() + float(seconds)
    print(json.dumps(ATTACKS[name](endpoint, lambda: time.monotonic() < until_s, int(count))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
