"""The streams over TCP, the relay's, by ZeroMQ's XPUB."""

import math
from collections import Counter
from typing import Any

import zmq

from taxeld.stream import messages
from taxeld.stream.door import Door
from taxeld.stream.guard import Guard
from taxeld.stream.sockets import connection_of, hang_up, is_waiting, open_socket
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

LISTEN_S = 0.05  # between looks at who has come
EVENTS_PER_LOOK = 512
EVENTS_QUEUED = 2  # a peer: more, and ZeroMQ holds a look while one floods; 1, and no CURVE works
INFO_S = 0.1  # at least, between greetings


class NetworkStream:
    """Endpoints that are all plain, or all take keys, as a socket is either plain or CURVE."""

    def __init__(
        self,
        context: zmq.Context[Any],
        queue: int,
        counters: SubscriberCounters,
        guard: Guard | None,
    ) -> None:
        """`guard`: who is let in; None: whoever comes."""
        self.wanted: frozenset[bytes] = frozenset()
        self._counters = counters
        self._prefixes: set[bytes] = set()  # of our topics alone, so few
        self._events: Counter[int] = Counter()  # of each peer, by its connection
        self._newcomers = False
        self._next_look_s = self._next_info_s = self._count_ends_s = -math.inf
        self._socket = open_socket(
            context, zmq.XPUB, send=queue, receive=EVENTS_QUEUED, largest=PREFIX_MAX
        )
        # else a second subscriber of a topic goes unnoticed
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        if guard is not None:
            guard.serve(self._socket)

    def bind(self, endpoint: str, key: str) -> None:
        """Raises SetupError, in the name of `key`, where the endpoint cannot be had."""
        Door(endpoint, key).let_in(self._socket)

    def listen(self, now_s: float, info: Frames | None) -> None:
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + LISTEN_S
        if now_s >= self._count_ends_s:
            self._count_ends_s = now_s + COUNTED_S
            self._events.clear()
        for _ in range(EVENTS_PER_LOOK):
            if not is_waiting(self._socket):
                break
            self._take(self._socket.recv(zmq.NOBLOCK, copy=False))
        if self._newcomers and info is not None and now_s >= self._next_info_s:
            self._newcomers = False
            self._next_info_s = now_s + INFO_S
            self.forward(info)

    def forward(self, frames: Frames) -> None:
        self._socket.send_multipart(frames, flags=zmq.NOBLOCK)

    def close(self) -> None:
        self._socket.close()

    def _take(self, frame: zmq.Frame) -> None:
        connection = connection_of(frame)
        self._hear(frame.bytes, connection is not None)
        if connection is None:
            return
        self._events[connection] += 1
        if self._events[connection] > EVENTS_MAX:
            self._events[connection] = 0
            self._counters.hung_up += hang_up(frame)

    def _hear(self, event: bytes, is_peers: bool) -> None:
        """A subscription is 1 and a prefix of topics, the end of one is 0 and that.

        One that a peer ends may be nobody's, or another's. Only ZeroMQ knows that the last one has
        gone, and says so when a connection ends.
        """
        first, prefix = event[:1], event[1:]
        if first not in (BEGIN, END):
            self._counters.malformed += 1
            return
        topics = topics_of([prefix])
        if first == BEGIN:
            self._counters.joined += bool(topics)
            self._counters.foreign += not topics
            if topics:
                self._prefixes.add(prefix)
                self._newcomers |= messages.INFO in topics
        else:
            self._counters.left += bool(topics)
            if not is_peers:
                self._prefixes.discard(prefix)
        self.wanted = topics_of(self._prefixes)
