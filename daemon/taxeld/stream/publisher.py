"""What is published, on all endpoints.

Nothing here waits: what a subscriber does not fetch is dropped for it alone, and what arrives is
taken up to a bound.
"""

import math
from typing import Any

import msgpack
import zmq

from taxeld.config import endpoints
from taxeld.stream import messages
from taxeld.stream.guard import Guard
from taxeld.stream.local_stream import LocalStream
from taxeld.stream.network_stream import NetworkStream
from taxeld.stream.subscriptions import Frames, Outlet, SubscriberCounters

LOOK_S = 0.005  # at least, between looks at who has come


class Publisher:
    """[topic, msgpack map, b"%.6f" of the measurement's Unix time] to whoever subscribes."""

    def __init__(
        self,
        context: zmq.Context[Any],
        queue: int,
        info: dict[str, Any] | None = None,
        guard: Guard | None = None,
        frames: int = 3,
    ) -> None:
        """`queue`: messages kept for a subscriber that is slow; `info`: for a new one, if it is
        known yet; `guard`: of the endpoints that take keys; `frames`: of a message, 2 without its
        time."""
        self.counters = SubscriberCounters()
        self._context = context
        self._queue = queue
        self._guard = guard
        self._frames = frames
        self._pack = msgpack.Packer().pack
        self._info = None if info is None else self._pack(info)
        self._next_look_s = -math.inf
        self._outlets: list[Outlet] = []

    def bind(self, served: tuple[str, ...], key: str) -> None:
        """Raises SetupError, in the name of `key`, where an endpoint cannot be had."""
        networks: dict[bool, NetworkStream] = {}
        for endpoint in served:
            if endpoints.ipc_path(endpoint) is not None:
                self._outlets.append(LocalStream(endpoint, key, self._queue, self.counters))
                continue
            guard = self._guard
            if guard is not None and not guard.takes_keys(endpoint):
                guard = None
            if (guard is None) not in networks:
                made = NetworkStream(self._context, self._queue, self.counters, guard)
                networks[guard is None] = made
                self._outlets.append(made)
            networks[guard is None].bind(endpoint, key)

    def filenos(self) -> list[int]:
        """Of Unix sockets', readable when somebody comes, subscribes or leaves."""
        return [o.fileno() for o in self._outlets if isinstance(o, LocalStream)]

    @property
    def wanted(self) -> frozenset[bytes]:
        """Topics that are worth making: who has asked for them is connected."""
        return frozenset().union(*(outlet.wanted for outlet in self._outlets))

    def wants(self, topic: bytes) -> bool:
        return any(topic in outlet.wanted for outlet in self._outlets)

    def send(self, topic: bytes, message: dict[str, Any], t: float) -> None:
        if self.wants(topic):
            self.forward((topic, self._pack(message), b"%.6f" % t))

    def forward(self, frames: Frames) -> None:
        """Send a message as it came; what it says of who speaks is kept for newcomers."""
        if frames[0] == messages.INFO:
            self._info = frames[1]
        for outlet in self._outlets:
            outlet.forward(frames[: self._frames])

    def greet(self, now_s: float, t: float) -> None:
        """Take subscriptions, and send newcomers `/taxeld/info`; `now_s` is monotonic."""
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + LOOK_S
        info: Frames | None = None
        if self._info is not None:
            info = (messages.INFO, self._info, b"%.6f" % t)[: self._frames]
        for outlet in self._outlets:
            outlet.listen(now_s, info)

    def close(self) -> None:
        for outlet in self._outlets:
            outlet.close()
