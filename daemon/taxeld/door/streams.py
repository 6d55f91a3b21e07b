"""What is published, on all endpoints, by ZeroMQ's XPUB.

A message that a subscriber does not fetch in time is lost for that subscriber alone.
"""

import math
import os
from collections import Counter
from collections.abc import Collection, Iterable, Set
from typing import Any

import zmq

from taxeld.stream.sockets import connection_of, is_waiting, open_socket
from taxeld.stream.topics import INFO, TOPICS

BEGIN, END = b"\x01", b"\x00"  # the byte before a prefix of topics
PREFIX_MAX = 1024  # bytes
SEND_BYTES = 32_768  # of a slow subscriber in the kernel, over TCP
EVENTS_PER_LOOK = 512
EVENTS_QUEUED = 2  # of a peer: with more a look is long while one floods; with 1 no CURVE works
INFO_S = 0.1  # at least, between two greetings


class Streams:
    """Endpoints of one kind: all plain, or all with keys, as a socket is either."""

    def __init__(self, socket: zmq.Socket[Any]) -> None:
        """`socket`: from `open_publisher`."""
        self.socket = socket
        self._prefixes: Counter[bytes] = Counter()  # connections that hear a prefix of our topics
        self._asked: dict[tuple[int, int], set[bytes]] = {}  # by descriptor and inode
        self._greets = False
        self._next_info_s = -math.inf

    @property
    def wanted(self) -> Set[bytes]:
        """Topics that somebody has subscribed to."""
        begins = tuple(self._prefixes)
        return {topic for topic in TOPICS if topic.startswith(begins)} if begins else set()

    def listen(self) -> None:
        """Take subscriptions."""
        for _ in range(EVENTS_PER_LOOK):
            if not is_waiting(self.socket):
                return
            self._take(self.socket.recv(zmq.NOBLOCK, copy=False))

    def greet(self, now_s: float, info: Collection[bytes]) -> None:
        """Send `/taxeld/info` where a newcomer has asked for it and `info` is not empty; `now_s` is
        monotonic."""
        if self._greets and info and now_s >= self._next_info_s:
            self._greets, self._next_info_s = False, now_s + INFO_S
            self.send(info)

    def send(self, frames: Iterable[bytes]) -> None:
        """A message: topic, map and time."""
        self.socket.send_multipart(list(frames), flags=zmq.NOBLOCK)

    def look(self) -> None:
        """Find who has gone."""
        for number, inode in list(self._asked):
            if _inode(number) != inode:
                self._prefixes -= Counter(self._asked.pop((number, inode)))

    def close(self) -> None:
        self.socket.close()

    def _take(self, frame: zmq.Frame) -> None:
        number = connection_of(frame)
        if number is None:  # ZeroMQ's own, for a connection that has ended: `look` finds it
            return
        inode = _inode(number)
        if inode is not None:
            self._hear(self._asked.setdefault((number, inode), set()), frame.bytes)

    def _hear(self, asked: set[bytes], event: bytes) -> None:
        """A subscription is 1 and a prefix of topics, the end of one is 0 and that."""
        first, prefix = event[:1], event[1:]
        is_ours = any(topic.startswith(prefix) for topic in TOPICS)
        if first == BEGIN and is_ours:
            self._greets |= INFO.startswith(prefix)
            if prefix not in asked:
                asked.add(prefix)
                self._prefixes[prefix] += 1
        elif first == END and prefix in asked:
            asked.remove(prefix)
            self._prefixes -= Counter([prefix])


def _inode(number: int) -> int | None:
    try:
        return os.fstat(number).st_ino
    except OSError:
        return None


def open_publisher(context: zmq.Context[Any], queue: int) -> zmq.Socket[Any]:
    """An XPUB that keeps `queue` messages for a slow subscriber and hears each subscription."""
    socket = open_socket(context, zmq.XPUB, send=queue, receive=EVENTS_QUEUED, largest=PREFIX_MAX)
    socket.setsockopt(zmq.SNDBUF, SEND_BYTES)
    # without these a second subscriber of a topic, and the end of one of two, go unnoticed
    socket.setsockopt(zmq.XPUB_VERBOSE, 1)
    socket.setsockopt(zmq.XPUB_VERBOSER, 1)
    return socket
