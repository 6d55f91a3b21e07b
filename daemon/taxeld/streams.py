"""The published streams, and the robot's sensor poses.

Nothing here waits: what a subscriber does not fetch is dropped for it alone, and what arrives is
taken up to a bound.
"""

import math
from typing import Any

import msgpack
import zmq

from taxeld import messages
from taxeld.curve import Guard
from taxeld.poses import PoseTrack
from taxeld.sockets import Inbox, bind, connect, open_socket, unpack

POSES_PER_TICK = 200
POSE_FRAMES = 3
POSE_BYTES = 1024
LISTEN_S = 0.05  # between looks at who has come and gone
EVENTS_PER_LOOK = 512
EVENTS_QUEUED = 2  # a peer: more, and ZeroMQ holds a tick while one floods; 1, and no CURVE works
EVENT_BYTES = 1024  # a topic's prefix; a CURVE handshake takes 400
INFO_S = 0.1  # at least, between greetings


class Publisher:
    """XPUB on all endpoints: [topic, msgpack map, b"%.6f" of the measurement's Unix time].

    Those that take keys have a socket of their own, as a socket speaks either plainly or CURVE.
    """

    def __init__(
        self, context: zmq.Context[Any], queue: int, info: dict[str, Any], guard: Guard
    ) -> None:
        """`queue`: messages kept for a subscriber that is slow; `info`: for a new one."""
        self._context = context
        self._queue = queue
        self._guard = guard
        self._pack = msgpack.Packer().pack
        self._info = self._pack(info)
        self._newcomers = False
        self._next_look_s = self._next_info_s = -math.inf
        self._outlets: dict[bool, _Outlet] = {}

    def bind(self, endpoints: tuple[str, ...]) -> None:
        """Raises SetupError where an endpoint cannot be had."""
        for endpoint in endpoints:
            keyed = self._guard.takes_keys(endpoint)
            if keyed not in self._outlets:
                self._outlets[keyed] = _Outlet(self._context, self._queue)
                if keyed:
                    self._guard.serve(self._outlets[keyed].socket)
            bind(self._outlets[keyed].socket, endpoint, "publish.endpoints")

    def wants(self, topic: bytes) -> bool:
        """Whether anybody listens, so that it is worth making."""
        return any(topic in outlet.wanted for outlet in self._outlets.values())

    def send(self, topic: bytes, message: dict[str, Any], t: float) -> None:
        self._send(topic, self._pack(message), t)

    def greet(self, now_s: float, t: float) -> None:
        """Hear who came and went, and tell newcomers who speaks; `now_s` is monotonic."""
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + LISTEN_S
        for outlet in self._outlets.values():
            self._newcomers |= outlet.listen()
        if self._newcomers and now_s >= self._next_info_s:
            self._newcomers = False
            self._next_info_s = now_s + INFO_S
            self._send(messages.INFO, self._info, t)

    def close(self) -> None:
        for outlet in self._outlets.values():
            outlet.socket.close()

    def _send(self, topic: bytes, body: bytes, t: float) -> None:
        frames = (topic, body, b"%.6f" % t)
        for outlet in self._outlets.values():
            outlet.socket.send_multipart(frames, flags=zmq.NOBLOCK)


class _Outlet:
    """A socket, and the topics that its subscribers want."""

    def __init__(self, context: zmq.Context[Any], queue: int) -> None:
        self.wanted: frozenset[bytes] = frozenset()
        self.socket = open_socket(
            context, zmq.XPUB, send=queue, receive=EVENTS_QUEUED, largest=EVENT_BYTES
        )
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # a late joiner of a known topic is heard too
        self._prefixes: set[bytes] = set()  # of our topics alone, so few

    def listen(self) -> bool:
        """Hear subscriptions; → whether one of them wants to know who speaks."""
        newcomer = False
        for _ in range(EVENTS_PER_LOOK):
            try:
                event = self.socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                break
            joins, prefix = event[:1] == b"\x01", event[1:]
            if not any(topic.startswith(prefix) for topic in messages.TOPICS):
                continue
            newcomer |= joins and messages.INFO.startswith(prefix)
            (self._prefixes.add if joins else self._prefixes.discard)(prefix)
            self.wanted = frozenset(
                topic for topic in messages.TOPICS if topic.startswith(tuple(self._prefixes))
            )
        return newcomer


class PoseInput:
    """SUB to the robot: `/robot/sensor_pose`, a map {t, x, y, theta}."""

    def __init__(self, context: zmq.Context[Any], track: PoseTrack, guard: Guard) -> None:
        self.malformed = 0
        self._track = track
        self._guard = guard
        self._socket = open_socket(
            context, zmq.SUB, send=1, receive=2 * POSES_PER_TICK, largest=POSE_BYTES
        )
        self._socket.setsockopt(zmq.SUBSCRIBE, messages.SENSOR_POSE)
        self._inbox = Inbox(self._socket, POSE_FRAMES)

    def connect(self, endpoint: str) -> None:
        """Raises SetupError where the endpoint is none."""
        if self._guard.takes_keys(endpoint):
            self._guard.join(self._socket)
        connect(self._socket, endpoint, "sensor_pose.endpoint")

    def poll(self) -> None:
        """Take the poses that have arrived."""
        for parts in self._inbox.take(POSES_PER_TICK * POSE_FRAMES):
            pose = _pose(parts)
            if pose is None:
                self.malformed += 1
            else:
                self._track.add(*pose)

    def close(self) -> None:
        self._socket.close()


def _pose(parts: list[bytes]) -> tuple[float, float, float, float] | None:
    if len(parts) != POSE_FRAMES:
        return None
    message = unpack(parts[1])
    values = [message.get(key) for key in ("t", "x", "y", "theta")]
    if not all(isinstance(v, (int, float)) and math.isfinite(v) for v in values):
        return None
    t, x, y, theta = (float(v) for v in values if v is not None)
    return t, x, y, theta
