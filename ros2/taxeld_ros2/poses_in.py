"""Where the skin is, from ROS 2: its poses go on to the daemon as `/robot/sensor_pose`."""

import logging
import math
import time
from collections.abc import Callable
from typing import Any

import msgpack
import zmq

from taxeld.arrays import Floats
from taxeld.config import endpoints
from taxeld.errors import SetupError
from taxeld.stream import messages
from taxeld.stream.sockets import open_socket, why
from taxeld_ros2.dds import AGAIN_S, BEST_EFFORT, LATCHED, RELIABLE, Participant, taken
from taxeld_ros2.transforms import Transforms, matrix

TILT_RAD = 0.1  # a link that leans farther from upright has no planar pose
PATIENCE_S = 5.0  # without a pose before a line says so
OFF_S = 1.0  # stamps farther from this machine's clock are of another clock
QUEUE = 1000  # poses that wait for the daemon

Places = list[tuple[float, Floats]]  # Unix seconds, and the skin's frame in the world's (4, 4)

log = logging.getLogger(f"taxeld.{__name__}")  # the command writes the logs of taxeld


class FromTransforms:
    """A frame in another, as robot_state_publisher and others publish it on /tf and /tf_static."""

    def __init__(self, dds: Participant, parent: str, child: str, wake: Callable[[], None]) -> None:
        self._transforms = Transforms(parent, child)
        self.silence = (
            f"no transforms that move lead from the frame '{parent}' to '{child}'; look at "
            "'ros2 run tf2_tools view_frames'"
        )
        kind = "tf2_msgs/TFMessage"
        self._static = dds.reader("tf_static", kind, wake, RELIABLE, LATCHED)
        self._moving = dds.reader("tf", kind, wake, RELIABLE)

    def take(self) -> Places:
        """The places that have come since the last call."""
        found = []
        for reader in (self._static, self._moving):
            for message in taken(reader):
                for one in message.transforms:
                    t = math.inf if reader is self._static else _seconds(one.header.stamp)
                    place = _matrix(one.transform.translation, one.transform.rotation)
                    self._transforms.take(t, one.header.frame_id, one.child_frame_id, place)
                news = self._transforms.news()
                found += [news] if news else []
        return found


class FromTopic:
    """A topic of geometry_msgs/msg/PoseStamped: the skin's sensor frame in the world."""

    def __init__(self, dds: Participant, topic: str, wake: Callable[[], None]) -> None:
        name = "/" + topic.strip("/")
        self.silence = (
            f"no geometry_msgs/msg/PoseStamped came on {name} in domain {dds.domain}; look at "
            f"'ros2 topic info {name}' and ROS_DOMAIN_ID"
        )
        self._reader = dds.reader(topic, "geometry_msgs/PoseStamped", wake, BEST_EFFORT)

    def take(self) -> Places:
        """The places that have come since the last call."""
        found = (
            (_seconds(m.header.stamp), _matrix(m.pose.position, m.pose.orientation))
            for m in taken(self._reader)
        )
        return [(t, place) for t, place in found if place is not None]


class SensorPose:
    """Publishes the places of a source where the daemon expects the robot, and says what is wrong
    with them."""

    def __init__(
        self, context: "zmq.Context[Any]", endpoint: str, source: FromTransforms | FromTopic
    ) -> None:
        """Raises SetupError: the endpoint cannot be used."""
        if not endpoints.is_local(endpoint):
            raise SetupError(
                f"sensor_pose.endpoint: '{endpoint}' is not of this machine; run the bridge beside "
                "the daemon, with an endpoint as tcp://127.0.0.1:9874"
            )
        self._source = source
        self._next_s: dict[str, float] = {}  # monotonic time when a kind of line may come again
        self._since_s = time.monotonic()
        self._socket = open_socket(context, zmq.PUB, send=QUEUE, receive=1, largest=1024)
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise SetupError(
                f"sensor_pose.endpoint: cannot publish at {endpoint} ({why(error)}); does "
                "something else publish the robot's pose there?"
            ) from None

    def close(self) -> None:
        self._socket.close()

    def serve(self) -> None:
        """Hand on the places that have come since."""
        now_s = time.monotonic()
        for t, place in self._source.take():
            self._since_s = now_s
            tilt = math.acos(min(1.0, max(-1.0, place[2, 2])))
            off_s = t - time.time()
            if tilt > TILT_RAD:
                degrees = math.degrees(tilt)
                text = f"the skin's z axis is {degrees:.0f}° from upright: such poses are left out"
                self._say("tilt", text, now_s)
                continue
            if abs(off_s) > OFF_S:
                text = f"sensor poses are stamped {off_s:+.0f} s from this machine's clock, so the "
                text += "daemon does not take them; is it a simulation's time?"
                self._say("clock", text, now_s)
            x, y = map(float, place[:2, 3])
            body = {"t": t, "x": x, "y": y, "theta": math.atan2(place[1, 0], place[0, 0])}
            frames = messages.SENSOR_POSE, msgpack.packb(body), b"%.6f" % t
            self._socket.send_multipart(frames, zmq.NOBLOCK)
        if now_s - self._since_s > PATIENCE_S:
            self._say("silence", f"no sensor pose: {self._source.silence}", now_s)

    def _say(self, kind: str, text: str, now_s: float) -> None:
        if now_s >= self._next_s.get(kind, -math.inf):
            self._next_s[kind] = now_s + AGAIN_S
            log.warning(text)


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def _matrix(at: Any, turn: Any) -> Floats | None:
    """(4, 4) of a ROS position and quaternion."""
    return matrix((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))
