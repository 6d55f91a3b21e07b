"""Where the skin is, from ROS 2: transforms, or a topic of poses."""

import logging
import math
import time
from collections.abc import Callable
from typing import Protocol

from taxeld_ros2 import ros_types as ros
from taxeld_ros2.dds import (
    AGAIN_S,
    BEST_EFFORT,
    LATCHED,
    RELIABLE,
    Participant,
    last,
    ros_type,
    taken,
)
from taxeld_ros2.stream import PoseOutput
from taxeld_ros2.transforms import Rigid, Transforms

TILT_RAD = 0.1  # of the link from upright, beyond which its pose is not planar
PATIENCE_S = 5.0  # without a pose, until that is said
OFF_S = 1.0  # stamps so far from this machine's clock are of another

log = logging.getLogger(f"taxeld.{__name__}")  # which the command has written


class Source(Protocol):
    """Where poses come from."""

    def take(self) -> list[tuple[float, Rigid]]:
        """Those that have come since, with their times."""
        ...

    def fault(self) -> str:
        """Why none comes, as far as it is known."""
        ...


class FromTransforms:
    """A frame in another, as robot_state_publisher and others tell it on /tf and /tf_static."""

    def __init__(self, dds: Participant, parent: str, child: str, wake: Callable[[], None]) -> None:
        self._transforms = Transforms(parent, child)
        self._readers = (
            (dds.reader("tf_static", ros.TFMessage, last(100, RELIABLE, LATCHED), wake), True),
            (dds.reader("tf", ros.TFMessage, last(100, RELIABLE), wake), False),
        )

    def take(self) -> list[tuple[float, Rigid]]:
        found = []
        for reader, is_static in self._readers:
            for message in taken(reader):
                for one in message.transforms:
                    self._take(one, is_static)
                told = self._transforms.news()
                found += [told] if told else []
        return found

    def _take(self, one: ros.TransformStamped, is_static: bool) -> None:
        rigid = _rigid(one.transform.translation, one.transform.rotation)
        t = _seconds(one.header.stamp)
        parent, child = one.header.frame_id, one.child_frame_id
        self._transforms.take(t, parent, child, rigid, is_static)

    def fault(self) -> str:
        return self._transforms.fault()


class FromTopic:
    """A topic of geometry_msgs/msg/PoseStamped: the skin's sensor frame in the world."""

    def __init__(self, dds: Participant, topic: str, wake: Callable[[], None]) -> None:
        self._dds, self._topic = dds, topic
        self._reader = dds.reader(topic, ros.PoseStamped, last(100, BEST_EFFORT), wake)

    def take(self) -> list[tuple[float, Rigid]]:
        found = []
        for message in taken(self._reader):
            t = _seconds(message.header.stamp)
            rigid = _rigid(message.pose.position, message.pose.orientation)
            if rigid is not None:
                found.append((t, rigid))
        return found

    def fault(self) -> str:
        wanted, there = ros_type(ros.PoseStamped), self._dds.kinds_of(self._topic)
        name = "/" + self._topic.strip("/")
        if not there:
            return f"nothing publishes {name} in domain {self._dds.domain}"
        if wanted not in there:
            return f"{name} is of {', '.join(sorted(there))}, not of {wanted}"
        return ""


class SensorPose:
    """Hands the poses of a source on to the daemon, and says what is wrong with them."""

    def __init__(self, source: Source, output: PoseOutput) -> None:
        self.tilted = 0  # poses that are not planar
        self._source, self._output = source, output
        self._next: dict[str, float] = {}  # when a line of a kind may be said again, monotonic
        self._since_s = time.monotonic()

    def serve(self) -> None:
        now_s = time.monotonic()
        for t, rigid in self._source.take():
            self._since_s = now_s
            if rigid.tilt > TILT_RAD:
                self.tilted += 1
                self._say(
                    "tilt", f"the skin's z axis is {math.degrees(rigid.tilt):.0f}° from upright: "
                    "such poses are left out",
                )  # fmt: skip
                continue
            off_s = t - time.time()
            if abs(off_s) > OFF_S:
                self._say(
                    "clock", f"sensor poses are stamped {off_s:+.0f} s from this machine's clock, "
                    "so the daemon does not take them; is it a simulation's time?",
                )  # fmt: skip
            x, y, _ = rigid.at
            self._output.send(t, x, y, rigid.yaw)
        if now_s - self._since_s > PATIENCE_S:
            why = self._source.fault() or "none has come"
            self._say("silent", f"no sensor pose: {why}")

    def _say(self, kind: str, text: str) -> None:
        now_s = time.monotonic()
        if now_s >= self._next.get(kind, -math.inf):
            self._next[kind] = now_s + AGAIN_S
            log.warning(text)


def _seconds(stamp: ros.Time) -> float:
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _rigid(at: ros.Point | ros.Vector3, turn: ros.Quaternion) -> Rigid | None:
    return Rigid.of((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))
