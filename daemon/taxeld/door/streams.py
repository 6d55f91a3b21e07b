"""What is published, on all endpoints, by ZeroMQ's XPUB.

A message that a subscriber does not fetch in time is lost for that subscriber alone.
"""

import contextlib
import math
from collections.abc import Sequence, Set
from typing import Any

import zmq

from taxeld.stream.sockets import MORE, NOBLOCK, open_socket
from taxeld.stream.topics import INFO, TOPICS

BEGIN, END = b"\x01", b"\x00"  # the byte before a prefix of topics
PREFIX_MAX = 1024  # bytes
SEND_BYTES = 32_768  # of a slow subscriber in the kernel, over TCP
EVENTS_PER_LOOK = 512
EVENTS_QUEUED = 2  # of a peer: with more a look is long while one floods; with 1 no CURVE works
INFO_S = 0.1  # at least, between two greetings


class Streams:
    """One endpoint, to be bound."""

    is_awaited = True

    def __init__(self, context: zmq.Context[Any], queue: int) -> None:
        """`queue`: messages that are kept for a slow subscriber."""
        self.socket = open_socket(
            context, zmq.XPUB, send=queue, receive=EVENTS_QUEUED, largest=PREFIX_MAX
        )
        self.socket.setsockopt(zmq.SNDBUF, SEND_BYTES)
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # else further subscribers go unnoticed
        self._prefixes = set[bytes]()  # of topics that somebody hears
        self._greets = False
        self._next_info_s = -math.inf

    @property
    def wanted(self) -> Set[bytes]:
        """Topics that somebody has subscribed to."""
        return {topic for topic in TOPICS if topic.startswith(tuple(self._prefixes))}

    def poll(self, now_s: float) -> None:  # noqa: ARG002
        with contextlib.suppress(zmq.Again):  # none is left
            for _ in range(EVENTS_PER_LOOK):
                self._take(self.socket.recv(NOBLOCK, copy=False))

    def greet(self, now_s: float, info: Sequence[bytes]) -> None:
        """Send `/taxeld/info` where a newcomer has asked for it and `info` is not empty; `now_s` is
        monotonic."""
        if self._greets and info and now_s >= self._next_info_s:
            self._greets, self._next_info_s = False, now_s + INFO_S
            self.send(info)

    def send(self, frames: Sequence[bytes]) -> None:
        """A message: topic, map and time."""
        *first, last = frames
        for frame in first:
            self.socket.send(frame, MORE)
        self.socket.send(last, NOBLOCK)

    def _take(self, frame: zmq.Frame) -> None:
        """The end of a prefix is believed only of ZeroMQ itself, which tells it when the last who
        hears the prefix has gone: a peer could name one that it does not hear."""
        event = frame.bytes
        first, prefix = event[:1], event[1:]
        if first == BEGIN and any(topic.startswith(prefix) for topic in TOPICS):
            self._prefixes.add(prefix)
            self._greets |= INFO.startswith(prefix)
        elif first == END and not _is_of_peer(frame):
            self._prefixes.discard(prefix)


def _is_of_peer(frame: zmq.Frame) -> bool:
    """Whether it came by a connection."""
    try:
        frame.get(zmq.SRCFD)
    except zmq.ZMQError:
        return False
    return True
