"""The robot's sensor poses, as they come."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zmq

from taxeld.pipeline.pose_watch import PoseFigures, PoseWatch
from taxeld.stream import curve, messages, sockets
from taxeld.stream.curve import RobotKeys
from taxeld.stream.pose_line import PoseLine
from taxeld.stream.sockets import open_socket, unpack

POSES_PER_TICK = 200
POSE_FRAMES = 3
POSE_BYTES = 1024
OTHER_BYTES = 65_536  # of what else the robot publishes

OnPose = Callable[[float, float, float, float, float], None]


@dataclass(slots=True)
class PoseCounters:
    """Since start."""

    malformed: int = 0  # messages of our topic that are no pose
    oversized: int = 0  # messages of too many frames, for which the robot is connected anew


class PoseInput:
    """SUB to the robot: `/robot/sensor_pose`, a map {t, x, y, theta}."""

    def __init__(
        self,
        context: zmq.Context[Any],
        endpoint: str,
        on_pose: OnPose,
        keys: RobotKeys | None = None,
        watch: PoseWatch | None = None,
    ) -> None:
        """`on_pose` is given every pose (t, x, y, θ) that is well-formed, and the time now;
        `watch` as well.

        Raises:
            SetupError: the endpoint is none.
        """
        self.counters = PoseCounters()
        self._context = context
        self._endpoint = endpoint
        self._on_pose = on_pose
        self._keys = keys
        self._watch = watch
        self._received = 0  # when last looked
        self._line = PoseLine(context, lambda topic: self._connect(topic, OTHER_BYTES))
        self._socket = self._open()

    @property
    def socket(self) -> zmq.Socket[Any]:
        """Another one after a message of too many frames. Its descriptor becomes readable when
        something comes after a poll that took all."""
        return self._socket

    def poll(self) -> None:
        """Take the poses that have arrived."""
        now = time.time()
        for parts in sockets.messages(self._socket, POSES_PER_TICK):
            if parts is None:
                self.counters.oversized += 1
                self._line.let_go()
                self._socket.close()
                self._socket = self._open()
                return
            if parts[0] != messages.SENSOR_POSE:  # its prefix is all that ZeroMQ looks at
                continue
            pose = as_pose(parts)
            if pose is None:
                self.counters.malformed += 1
            else:
                self._on_pose(*pose, now)
                if self._watch is not None:
                    self._watch.add(*pose[:3], now)

    def figures(self, now: float) -> PoseFigures:
        """How the poses come, at the Unix time now; asked once a second."""
        if self._watch is None:
            return PoseFigures()
        malformed, line = self.counters.malformed, self._line
        received = self._watch.figures.received
        line.look(has_poses=received > self._received)
        self._received = received
        return self._watch.look(
            now, malformed,
            connected=line.is_connected, refused=line.is_refused, topics=len(line.topics),
        )  # fmt: skip

    def clock_stepped(self) -> None:
        """The Unix clock was set."""
        if self._watch is not None:
            self._watch.clock_stepped()

    @property
    def topics(self) -> list[str]:
        """What else the robot publishes, where no pose comes."""
        return self._line.topics

    def close(self) -> None:
        self._line.close()
        self._socket.close()

    def _open(self) -> zmq.Socket[Any]:
        return self._connect(messages.SENSOR_POSE, POSE_BYTES, self._line.follow)

    def _connect(
        self,
        topic: bytes,
        largest: int,
        before: Callable[[zmq.Socket[Any]], None] = lambda _: None,
    ) -> zmq.Socket[Any]:
        socket = open_socket(
            self._context, zmq.SUB, send=1, receive=2 * POSES_PER_TICK, largest=largest
        )
        socket.setsockopt(zmq.SUBSCRIBE, topic)
        if self._keys is not None:
            curve.as_client(socket, self._keys.robot, self._keys.public, self._keys.secret)
        before(socket)
        sockets.connect(socket, self._endpoint, "sensor_pose.endpoint")
        return socket


def as_pose(parts: list[bytes]) -> tuple[float, float, float, float] | None:
    """(t, x, y, θ) of a message; None where it is none."""
    if len(parts) != POSE_FRAMES:
        return None
    message = unpack(parts[1])
    try:
        pose = message["t"], message["x"], message["y"], message["theta"]
        if not all(map(math.isfinite, pose)):
            return None
        t, x, y, theta = map(float, pose)
    except (KeyError, TypeError):  # one lacks, or is no number
        return None
    return t, x, y, theta
