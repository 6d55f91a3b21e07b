"""The published streams, and those who subscribe to them.

Nothing here waits: what a subscriber does not fetch is dropped for it alone, and what arrives is
taken up to a bound.
"""

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import msgpack
import zmq

from taxeld.stream import messages
from taxeld.stream.door import Door
from taxeld.stream.guard import Guard
from taxeld.stream.sockets import connection_of, hang_up, is_waiting, open_socket

LISTEN_S = 0.05  # between looks at who has come
EVENTS_PER_LOOK = 512
EVENTS_QUEUED = 2  # a peer: more, and ZeroMQ holds a tick while one floods; 1, and no CURVE works
EVENT_BYTES = 1024  # a topic's prefix; a CURVE handshake takes 400
EVENTS_MAX = 256  # of a peer in COUNTED_S; of more it is hung up on
COUNTED_S = 10.0
INFO_S = 0.1  # at least, between greetings
DOORS_S = 1.0  # between looks at the socket files

Frames = tuple[bytes, bytes, bytes]


@dataclass(slots=True)
class SubscriberCounters:
    """Since start."""

    joined: int = 0  # subscriptions to topics of ours
    left: int = 0  # ends of subscriptions
    foreign: int = 0  # subscriptions to none of our topics
    malformed: int = 0  # messages that are neither
    hung_up: int = 0  # peers that sent too many of any
    bound_again: int = 0  # socket files that had vanished


class Publisher:
    """XPUB on all endpoints: [topic, msgpack map, b"%.6f" of the measurement's Unix time].

    Those that take keys have a socket of their own, as a socket is either plain or CURVE.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        queue: int,
        info: dict[str, Any] | None = None,
        guard: Guard | None = None,
    ) -> None:
        """`queue`: messages kept for a subscriber that is slow; `info`: for a new one, if it is
        known yet; `guard`: of the endpoints that take keys."""
        self.counters = SubscriberCounters()
        self.wanted: frozenset[bytes] = frozenset()  # topics
        self._context = context
        self._queue = queue
        self._guard = guard
        self._pack = msgpack.Packer().pack
        self._info = None if info is None else self._pack(info)
        self._newcomers = False
        self._next_look_s = self._next_info_s = self._next_doors_s = -math.inf
        self._count_ends_s = -math.inf
        self._sockets: dict[bool, zmq.Socket[Any]] = {}
        self._doors: list[tuple[Door, zmq.Socket[Any]]] = []
        self._prefixes: set[tuple[bool, bytes]] = set()  # of our topics alone, so few
        self._events: Counter[tuple[bool, int]] = Counter()  # of each peer, by its connection

    def bind(self, endpoints: tuple[str, ...], key: str) -> None:
        """Raises SetupError, in the name of `key`, where an endpoint cannot be had."""
        for endpoint in endpoints:
            keyed = self._guard is not None and self._guard.takes_keys(endpoint)
            if keyed not in self._sockets:
                self._sockets[keyed] = self._open(keyed)
            door = Door(endpoint, key)
            self._doors.append((door, self._sockets[keyed]))
            door.let_in(self._sockets[keyed])

    def wants(self, topic: bytes) -> bool:
        """Whether it is worth making: who has asked for it is connected."""
        return topic in self.wanted

    def send(self, topic: bytes, message: dict[str, Any], t: float) -> None:
        self.forward((topic, self._pack(message), b"%.6f" % t))

    def forward(self, frames: Frames) -> None:
        """Send a message as it came; what it says of who speaks is kept for newcomers."""
        if frames[0] == messages.INFO:
            self._info = frames[1]
        for socket in self._sockets.values():
            socket.send_multipart(frames, flags=zmq.NOBLOCK)

    def greet(self, now_s: float, t: float) -> None:
        """Take subscriptions, and send newcomers `/taxeld/info`; `now_s` is monotonic."""
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + LISTEN_S
        if now_s >= self._count_ends_s:
            self._count_ends_s = now_s + COUNTED_S
            self._events.clear()
        for keyed, socket in self._sockets.items():
            self._listen(keyed, socket)
        if self._newcomers and self._info is not None and now_s >= self._next_info_s:
            self._newcomers = False
            self._next_info_s = now_s + INFO_S
            self.forward((messages.INFO, self._info, b"%.6f" % t))
        if now_s >= self._next_doors_s:
            self._next_doors_s = now_s + DOORS_S
            self.counters.bound_again += sum(door.restore(socket) for door, socket in self._doors)

    def close(self) -> None:
        for socket in self._sockets.values():
            socket.close()
        for door, _ in self._doors:
            door.close()

    def _open(self, keyed: bool) -> zmq.Socket[Any]:
        socket = open_socket(
            self._context, zmq.XPUB, send=self._queue, receive=EVENTS_QUEUED, largest=EVENT_BYTES
        )
        # else a second subscriber of a topic goes unnoticed
        socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        if keyed and self._guard is not None:
            self._guard.serve(socket)
        return socket

    def _listen(self, keyed: bool, socket: zmq.Socket[Any]) -> None:
        for _ in range(EVENTS_PER_LOOK):
            if not is_waiting(socket):
                return
            frame = socket.recv(zmq.NOBLOCK, copy=False)
            connection = connection_of(frame)
            self._hear(keyed, frame.bytes, connection is not None)
            if connection is None:
                continue
            peer = keyed, connection
            self._events[peer] += 1
            if self._events[peer] > EVENTS_MAX:
                self._events[peer] = 0
                self.counters.hung_up += hang_up(frame)

    def _hear(self, keyed: bool, event: bytes, is_peers: bool) -> None:
        """A subscription is 1 and a prefix of topics, the end of one is 0 and that.

        One that a peer ends may be nobody's, or another's. Only ZeroMQ knows that the last one has
        gone, and says so when a connection ends.
        """
        prefix = event[1:]
        topics = [topic for topic in messages.TOPICS if topic.startswith(prefix)]
        if event[:1] == b"\x01":
            self.counters.joined += bool(topics)
            self.counters.foreign += not topics
            if topics:
                self._prefixes.add((keyed, prefix))
                self._newcomers |= messages.INFO in topics
        elif event[:1] == b"\x00":
            self.counters.left += bool(topics)
            if not is_peers:
                self._prefixes.discard((keyed, prefix))
        else:
            self.counters.malformed += 1
            return
        prefixes = tuple(prefix for _, prefix in self._prefixes)
        self.wanted = frozenset(topic for topic in messages.TOPICS if topic.startswith(prefixes))
