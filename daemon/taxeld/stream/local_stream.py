"""The streams over Unix sockets."""

import math
from collections.abc import Set

from taxeld.stream import messages, zmtp
from taxeld.stream.server import Peer, Server, Terms
from taxeld.stream.subscriptions import (
    BEGIN,
    COUNTED_S,
    END,
    EVENTS_MAX,
    PREFIX_MAX,
    Frames,
    SubscriberCounters,
    topics_of,
)

KINDS = frozenset((b"SUB", b"XSUB"))
EVENTS_PER_LOOK = 32


class Subscriber:
    """What a peer has asked for, of our topics alone, and how many messages it has sent of late."""

    __slots__ = ("events", "prefixes")

    def __init__(self) -> None:
        self.events = 0
        self.prefixes: set[bytes] = set()


class LocalStream:
    """One endpoint; who subscribes there costs a write a message."""

    def __init__(self, endpoint: str, key: str, queue: int, counters: SubscriberCounters) -> None:
        """Raises SetupError, in the name of `key`, where the endpoint cannot be had."""
        self._counters = counters
        self._subscribers: dict[Peer, Subscriber] = {}
        self._readers: dict[bytes, list[Peer]] | None = {}  # by topic; None: to be found anew
        self._count_ends_s = -math.inf
        terms = Terms(b"XPUB", KINDS, largest=PREFIX_MAX, frames=1, queue=queue)
        self._server = Server(endpoint, key, terms, counters, self._forget)

    @property
    def wanted(self) -> Set[bytes]:
        return self._by_topic().keys()

    def fileno(self) -> int:
        return self._server.fileno()

    def listen(self, now_s: float, info: Frames | None) -> None:
        if now_s >= self._count_ends_s:
            self._count_ends_s = now_s + COUNTED_S
            for subscriber in self._subscribers.values():
                subscriber.events = 0
        for peer, (event,) in self._server.look(now_s, EVENTS_PER_LOOK):
            subscriber = self._subscribers.setdefault(peer, Subscriber())
            subscriber.events += 1
            if subscriber.events > EVENTS_MAX:
                self._counters.hung_up += 1
                self._server.hang_up(peer)
            elif messages.INFO in self._hear(subscriber, event) and info is not None:
                self._server.send(peer, zmtp.packed(info))

    def forward(self, frames: Frames) -> None:
        readers = self._by_topic().get(frames[0])
        if readers:
            data = zmtp.packed(frames)
            for peer in readers:
                self._server.send(peer, data)

    def close(self) -> None:
        self._server.close()

    def _hear(self, subscriber: Subscriber, event: bytes) -> frozenset[bytes]:
        """→ the topics that it asks for."""
        first, prefix = event[:1], event[1:]
        if first not in (BEGIN, END):
            self._counters.malformed += 1
            return frozenset()
        topics = topics_of([prefix])
        if first == BEGIN:
            self._counters.joined += bool(topics)
            self._counters.foreign += not topics
            if topics:
                subscriber.prefixes.add(prefix)
                self._readers = None
            return topics
        if prefix in subscriber.prefixes:
            subscriber.prefixes.remove(prefix)
            self._counters.left += 1
            self._readers = None
        return frozenset()

    def _forget(self, peer: Peer) -> None:
        subscriber = self._subscribers.pop(peer, None)
        if subscriber is not None and subscriber.prefixes:
            self._counters.left += len(subscriber.prefixes)
            self._readers = None

    def _by_topic(self) -> dict[bytes, list[Peer]]:
        """Who is sent what; of topics that nobody wants there is none."""
        if self._readers is None:
            self._readers = {}
            for peer, subscriber in self._subscribers.items():
                for topic in topics_of(subscriber.prefixes):
                    self._readers.setdefault(topic, []).append(peer)
        return self._readers
