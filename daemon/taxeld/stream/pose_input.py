"""The robot's sensor poses, as they come."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zmq

from taxeld.stream import curve, messages, sockets
from taxeld.stream.curve import RobotKeys
from taxeld.stream.sockets import open_socket, unpack

POSES_PER_TICK = 200
POSE_FRAMES = 3
POSE_BYTES = 1024

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
    ) -> None:
        """`on_pose` is given every pose (t, x, y, θ) that is well-formed, and the time now.

        Raises:
            SetupError: the endpoint is none.
        """
        self.counters = PoseCounters()
        self._context = context
        self._endpoint = endpoint
        self._on_pose = on_pose
        self._keys = keys
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

    def close(self) -> None:
        self._socket.close()

    def _open(self) -> zmq.Socket[Any]:
        socket = open_socket(
            self._context, zmq.SUB, send=1, receive=2 * POSES_PER_TICK, largest=POSE_BYTES
        )
        socket.setsockopt(zmq.SUBSCRIBE, messages.SENSOR_POSE)
        if self._keys is not None:
            curve.as_client(socket, self._keys.robot, self._keys.public, self._keys.secret)
        sockets.connect(socket, self._endpoint, "sensor_pose.endpoint")
        return socket


def as_pose(parts: list[bytes]) -> tuple[float, float, float, float] | None:
    """(t, x, y, θ) of a message; None where it is none."""
    if len(parts) != POSE_FRAMES:
        return None
    message = unpack(parts[1])
    values = [message.get(key) for key in ("t", "x", "y", "theta")]
    if not all(isinstance(v, (int, float)) and math.isfinite(v) for v in values):
        return None
    t, x, y, theta = (float(v) for v in values if v is not None)
    return t, x, y, theta
