"""The bridge: what the daemon estimates goes out as ROS 2 topics, and the skin's pose comes in."""

import logging
import math
import time
from collections.abc import Callable
from typing import Any

import msgpack
import zmq

from taxeld.commands.running import Subscriber
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld.service.notify import Notifier
from taxeld.stream.sockets import open_socket, why
from taxeld.stream.topics import ESTIMATE, HEALTH, SENSOR_POSE
from taxeld_ros2 import dds

STEP_S = 0.005  # longest time that a pose of the skin waits
SILENT_S = 2.0  # after this long without an estimate no daemon is there
PATIENCE_S = 5.0  # without a pose of the skin before a line says so
PERIOD_S = 1.0  # of the diagnostics while the status stays
TILT_RAD = 0.1  # a link that leans farther from upright has no planar pose

log = logging.getLogger(f"taxeld.{__name__}")  # the command writes the logs of taxeld


class Bridge:
    """Opened, until `close`."""

    def __init__(self, stream: str, prefix: str, frame: str) -> None:
        """`stream`: where a daemon publishes, or will; `prefix` begins the names of the topics, and
        `frame` is that of their poses. Raises SetupError: one cannot be used, or DDS not be had."""
        self._where, self._prefix, self._frame = stream, prefix, frame
        self._last: dict[bytes, dict[str, Any]] = {}  # message of each topic
        self._heard_s = self._posed_s = time.monotonic()
        self._next_told_s = -math.inf  # the next diagnostics are due
        self._is_silent: bool | None = None  # None until a daemon is heard, or missed
        self._dds = dds.participant()
        self._pose = dds.writer(self._dds, f"{prefix}/pose", dds.SpreadStamped)
        self._modes = dds.writer(self._dds, f"{prefix}/modes", dds.PoseArray)
        self._diagnostics = dds.writer(self._dds, "diagnostics", dds.Diagnostics)
        self._streams = Subscriber(stream, [ESTIMATE, HEALTH])
        self._robot: zmq.Socket[Any] | None = None

    def listen(self, topic: str, endpoint: str) -> None:
        """Hand a topic's poses on, by an endpoint. Raises SetupError: it cannot be used."""
        self._topic, self._said = f"/{topic.strip('/')}", ""  # the last line on the poses
        context: zmq.Context[Any] = zmq.Context.instance()
        self._reader = dds.reader(self._dds, topic, dds.PoseStamped)
        self._robot = open_socket(context, zmq.PUB, send=1000, receive=1, largest=1024)
        try:
            self._robot.bind(endpoint)
        except zmq.ZMQError as error:
            fault = f"sensor_pose.endpoint: cannot publish at {endpoint} ({why(error)})"
            raise SetupError(f"{fault}; is it another's, or of another machine?") from None

    def run(self, stopping: Callable[[], bool]) -> None:
        """Until `stopping`. Raises WorkError: the daemon speaks another version of the stream."""
        notifier, step_s = Notifier(), 10.0 * STEP_S if self._robot is None else STEP_S
        notifier.ready()
        while not stopping():
            for topic, message in self._streams.wait(step_s):
                if topic == ESTIMATE:
                    self._on_estimate(message)
                self._last[topic] = message
            now_s = time.monotonic()
            self._tell(now_s)
            if self._robot is not None:
                self._hand_on(self._robot, now_s)
            notifier.tick(now_s, lambda _: f"{'no' if self._is_silent else 'a'} daemon is heard")
        notifier.stopping()

    def close(self) -> None:
        self._streams.close()
        if self._robot is not None:
            self._robot.close()

    def _on_estimate(self, e: dict[str, Any]) -> None:
        """Pose and modes of a scan's estimate are published while they may be used."""
        before, self._heard_s = self._last.get(ESTIMATE, {}), time.monotonic()
        if e["valid"] and e["t"] != before.get("t"):
            if e["status"] == Status.CONVERGED:
                dds.write(self._pose, dds.pose_with_covariance(e, self._frame))
            modes = [dds.pose(one) for one in e["modes"]]
            dds.write(self._modes, dds.PoseArray(dds.header(e["t"], self._frame), modes))
        if any(e[key] != before.get(key) for key in ("status", "why")):
            self._next_told_s = -math.inf

    def _tell(self, now_s: float) -> None:
        """Log whether a daemon is heard, and publish the diagnostics."""
        silent = now_s - self._heard_s > SILENT_S
        if silent != self._is_silent and (silent or ESTIMATE in self._last):
            self._is_silent, self._next_told_s = silent, -math.inf
            if silent:
                self._last.clear()
                log.warning("no daemon is heard at %s; is 'taxeld run' there? Waiting", self._where)
            else:
                log.info("ready: a daemon is heard at %s", self._where)
        if now_s >= self._next_told_s and (silent or ESTIMATE in self._last):
            self._next_told_s, name = now_s + PERIOD_S, f"{self._prefix}: estimate"
            last = self._last.get(ESTIMATE, {}), self._last.get(HEALTH, {})
            dds.write(self._diagnostics, dds.diagnostics(time.time(), name, *last))

    def _hand_on(self, robot: "zmq.Socket[Any]", now_s: float) -> None:
        """Send the poses of the skin that have come. What else may be wrong the daemon says."""
        fault = ""
        for m in dds.taken(self._reader):
            self._posed_s, t = now_s, m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec
            x, y, z, w = (getattr(m.pose.orientation, axis) for axis in "xyzw")
            length = x * x + y * y + z * z + w * w
            if not (length > 0.0 and x * x + y * y <= length * math.sin(0.5 * TILT_RAD) ** 2):
                fault = f"no sensor pose: its z axis is over {TILT_RAD} rad from upright"
                continue
            yaw = math.atan2(2.0 * (x * y + z * w), w * w + x * x - y * y - z * z)
            body = {"t": t, "x": m.pose.position.x, "y": m.pose.position.y, "theta": yaw}
            robot.send_multipart((SENSOR_POSE, msgpack.packb(body), b"%.6f" % t), zmq.NOBLOCK)
        if now_s - self._posed_s > PATIENCE_S:
            fault = f"no sensor pose: no PoseStamped comes on {self._topic}; look at "
            fault += f"'ros2 topic info {self._topic}' and ROS_DOMAIN_ID"
        if fault not in ("", self._said):
            self._said = fault
            log.warning(fault)
