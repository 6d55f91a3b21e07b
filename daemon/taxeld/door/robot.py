"""The robot's sensor poses, and the connection they come by.

SUB to `/robot/sensor_pose`, a map {t, x, y, theta}. While no pose comes, whatever else the robot
publishes is listened to for a moment, so that a wrong topic can be named.
"""

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import zmq

from taxeld.door.heard import REASON_MAX, Heard
from taxeld.stream import pair
from taxeld.stream.curve import RobotKeys
from taxeld.stream.sockets import unpack
from taxeld.stream.topics import SENSOR_POSE

POSE_FRAMES = 3
TOPICS_MAX, TOPIC_MAX = 4, 60  # other topics of the robot, and characters of each
POSE_KEYS = ("t", "x", "y", "theta")
THETA_MAX = 3.0 * math.pi  # beyond it an angle is in degrees; smaller ones cannot be told
DEGREES = "theta is beyond 1.5 turns: send radians from -pi to pi, not degrees"
DEGREES_S = 30.0  # for so long after such an angle, the smaller ones of this robot are refused too
NAME = re.compile(rb"[!-~]{0,%d}" % TOPIC_MAX)  # a topic up to where it is no text
SILENT_S = 1.0  # without a pose for so long, other topics are listened to
LISTEN_S, PAUSE_S = 3.0, 30.0  # for so long, and then not again

Pose = tuple[float, float, float, float]
OnPoses = Callable[[list[Pose], int], object]


class Robot(Heard):
    """One endpoint."""

    topic = SENSOR_POSE
    key = "sensor_pose.endpoint"

    def __init__(
        self,
        context: zmq.Context[Any],
        endpoint: str,
        on_poses: OnPoses,
        keys: RobotKeys | None,
        now_s: float,
        topics: Sequence[str] = (),
    ) -> None:
        """`topics`: of the links' sensors, where there are several; `on_poses` is given
        up to `pair.POSES_MAX` well-formed poses, and the number of their link; `now_s` is
        monotonic.

        Raises:
            SetupError: the endpoint is none.
        """
        self.is_awaited = False  # whether the loop waits for the next pose
        self._on_poses = on_poses
        # the links' topics with their numbers, and their poses that have not been passed on
        self._links = {topic.encode(): k for k, topic in enumerate(topics)} or {SENSOR_POSE: 0}
        self._came: list[list[Pose]] = [[] for _ in self._links]
        self._pose_s = now_s  # when the last one came
        self._listens_s: float | None = None  # since when to other topics
        self._pauses_s = -math.inf  # until then not again
        self._doubted_s = -math.inf  # until then small angles are taken to be in degrees
        super().__init__(context, endpoint, keys)

    def look(self, now_s: float) -> bool:
        if super().look(now_s):
            return True
        self._listen(now_s)
        return False

    def _open(self) -> None:
        self._listens_s = None
        super()._open()

    @property
    def topics(self) -> list[bytes]:
        return sorted({self.topic, *self._links})

    def _take(self, now_s: float, parts: list[bytes]) -> None:
        link = self._links.get(parts[0])
        is_glued = len(parts) == 1 and parts[0].startswith(tuple(self._links))
        if link is None and not is_glued:  # its prefix is all that ZeroMQ looks at
            name = NAME.findall(parts[0])[0].decode() or "a topic that is no text"
            known = self.line.topics
            if self._listens_s is not None and name not in known and len(known) < TOPICS_MAX:
                known.append(name)
            return
        pose = as_pose(parts)
        if pose == DEGREES:
            self._doubted_s = now_s + DEGREES_S
        elif now_s < self._doubted_s and not isinstance(pose, str):
            pose = DEGREES
        if isinstance(pose, str):
            self.line.malformed += 1
            self.line.reason = pair.printable(pose)[:REASON_MAX]
            return
        self._pose_s, self.is_awaited = now_s, False
        came = self._came[link or 0]
        came.append(pose)
        if len(came) == pair.POSES_MAX:
            self._pass_on()

    def _pass_on(self) -> None:
        for link, came in enumerate(self._came):
            if came:
                self._on_poses(came, link)
            came.clear()

    def _note(self, event: int, now_s: float) -> None:
        super()._note(event, now_s)
        if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._doubted_s = -math.inf  # another publisher, or this one mended

    def _listen(self, now_s: float) -> None:
        is_missed = self.line.connected and now_s > self._pose_s + SILENT_S
        if self._listens_s is None:
            if is_missed and now_s >= self._pauses_s:
                self._listens_s, self.line.topics = now_s, []
                self.socket.setsockopt(zmq.SUBSCRIBE, b"")
        elif not is_missed or now_s > self._listens_s + LISTEN_S:
            self._listens_s, self._pauses_s = None, now_s + PAUSE_S
            self.socket.setsockopt(zmq.UNSUBSCRIBE, b"")
        if now_s <= self._pose_s + SILENT_S:
            self.line.topics, self._pauses_s = [], -math.inf


def as_pose(parts: list[bytes]) -> Pose | str:
    """(t, x, y, θ) of a message, or the reason why it is none, with the cure."""
    if len(parts) != POSE_FRAMES:
        are = "topic and map are one frame" if len(parts) == 1 else f"they have {len(parts)} frames"
        return f"{are}: send three, the topic, one msgpack map, the time as text"
    message = unpack(parts[1])
    if not message:
        if parts[1].lstrip().startswith(b"{"):
            return "the map is JSON: pack it by msgpack"
        return "the second frame is no msgpack map {t, x, y, theta}"
    for key in POSE_KEYS:
        if key not in message:
            return f"key {key} lacks; the map has {', '.join(sorted(map(str, message)))}"
        value = message[key]
        if type(value) not in (int, float):
            return f"{key} is no number"
        if not math.isfinite(value):
            return f"{key} is not finite: leave such a pose out"
    t, x, y, theta = (float(message[key]) for key in POSE_KEYS)
    if abs(theta) > THETA_MAX:
        return DEGREES
    return t, x, y, theta
