"""Who publishes to the daemon: the robot its sensors' poses, an array its scans; by SUB.

A pose is a map {t, x, y, theta} under `/robot/sensor_pose`.
"""

import contextlib
import itertools
import math
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any

import zmq

from taxeld.stream import curve, pair
from taxeld.stream.curve import Keys
from taxeld.stream.link import PeerLine
from taxeld.stream.sockets import NOBLOCK, connect, is_waiting, open_socket, unpack
from taxeld.stream.topics import SENSOR_POSE
from taxeld_protocol import array
from taxeld_protocol.array import ArrayFrame

MESSAGES_PER_LOOK = 200
QUEUED = 256  # messages, between two looks as well
REASON_MAX = 120  # characters of why a message is none
AGAIN_S = 3.0  # without a connection for so long it is made anew
FAILED = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
WATCHED = (
    zmq.EVENT_CONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_CLOSED
    | FAILED
)
EVENT = struct.Struct("=HI")  # an event and its value: pyzmq's own reader brings all of asyncio
NUMBERS = itertools.count()  # each monitor has a name of its own

POSE_FRAMES = 3
POSE_KEYS = ("t", "x", "y", "theta")
THETA_MAX = 3.0 * math.pi  # beyond it an angle is in degrees; smaller ones cannot be told
DEGREES = "theta is beyond 1.5 turns: send radians from -pi to pi, not degrees"
STAMP_S = 1.0  # a pose so often is taken as it comes: the others are found some time afterwards
DEGREES_S = 30.0  # for so long after such an angle, the smaller ones of this robot are refused too

Pose = tuple[float, float, float, float]


class Heard:
    """A connection to somebody who publishes; a subclass takes the messages."""

    topics: Sequence[bytes] = (b"",)  # prefixes of the messages that are wanted
    largest = 65_536  # bytes of a message
    key = ""  # of the configuration
    is_awaited = True  # whether a message is to be taken at once

    def __init__(self, context: zmq.Context[Any], endpoint: str, keys: Keys | None = None) -> None:
        """Raises SetupError where the endpoint is none."""
        self.line = PeerLine()
        self._context, self._endpoint, self._keys = context, endpoint, keys
        self._open()

    def poll(self, now_s: float) -> None:
        """Take the messages that have arrived; `now_s` is monotonic."""
        with contextlib.suppress(zmq.Again):  # none is left
            for _ in range(MESSAGES_PER_LOOK):
                self._take(now_s, self.socket.recv_multipart(NOBLOCK))

    def look(self, now_s: float) -> None:
        """Find out what has become of the connection, a few times a second."""
        line = self.line
        while is_waiting(self._monitor):
            event = EVENT.unpack(self._monitor.recv_multipart()[0])[0]
            self._is_half_open = event == zmq.EVENT_CONNECTED
            if not self._is_half_open:
                line.connected = event == zmq.EVENT_HANDSHAKE_SUCCEEDED
            if event in (zmq.EVENT_HANDSHAKE_SUCCEEDED, zmq.EVENT_CLOSED):  # or nobody is there
                line.refused = False
            line.refused |= bool(event & FAILED)
        if line.connected:
            self._lost_s = now_s
        elif now_s > self._lost_s + AGAIN_S:
            # after an error of the protocol ZeroMQ does not connect again by itself
            line.refused |= self._is_half_open
            self.socket.disable_monitor()  # an event without a reader holds ZeroMQ up for ever
            self.socket.close()
            self._monitor.close()
            self._open()

    def _take(self, now_s: float, parts: list[bytes]) -> None:
        """A message has come."""
        raise NotImplementedError

    def _bad(self, reason: str) -> None:
        """A message of the topic is none."""
        self.line.malformed += 1
        self.line.reason = pair.printable(reason)[:REASON_MAX]

    def _open(self) -> None:
        self.socket = open_socket(
            self._context, zmq.SUB, send=len(self.topics) + 1, receive=QUEUED, largest=self.largest
        )
        # a queue of one would hold only one subscription
        for topic in self.topics:
            self.socket.setsockopt(zmq.SUBSCRIBE, topic)
        if self._keys is not None:
            keys = self._keys
            curve.as_client(self.socket, keys.robot, keys.public, keys.secret)
        where = f"inproc://heard-{next(NUMBERS)}"
        self.socket.monitor(where, WATCHED)
        self._monitor = self._context.socket(zmq.PAIR)
        self._monitor.connect(where)
        self._lost_s = time.monotonic()  # since when there is no connection
        self._is_half_open = False  # without a handshake
        connect(self.socket, self._endpoint, self.key)


class Array(Heard):
    """Arrays of any skin (docs/array.md): the map is the second frame, or the only one."""

    largest = 262_144
    key = "source.endpoint"

    def __init__(
        self, context: zmq.Context[Any], endpoint: str, on_array: Callable[[ArrayFrame], object]
    ) -> None:
        """Raises SetupError where the endpoint is none."""
        super().__init__(context, endpoint)
        self._on_array = on_array

    def _take(self, now_s: float, parts: list[bytes]) -> None:  # noqa: ARG002
        body = parts[len(parts) > 1]
        is_text = body.lstrip()[:1] == b"{"  # msgpack's number 123
        frame = array.parse(array.read_json(body) if is_text else unpack(body))
        if isinstance(frame, str):
            self._bad(frame)
        else:
            self._on_array(frame)


class Robot(Heard):
    """The poses of the robot's sensors. One that comes is taken at once only while the loop awaits
    it: a wake for each pose would cost more than all else that the door does."""

    key = "sensor_pose.endpoint"

    def __init__(
        self,
        context: zmq.Context[Any],
        endpoint: str,
        on_poses: Callable[[list[list[Pose]], bool], object],
        keys: Keys | None,
        topics: Sequence[str] = (),
    ) -> None:
        """`topics`: of the links' sensors, where there are several; `on_poses` is given well-formed
        poses, and the number of their link.

        Raises:
            SetupError: the endpoint is none.
        """
        self.is_awaited = False
        self._on_poses = on_poses
        # the links' topics with their numbers, and their poses that have not been passed on
        self._links = {topic.encode(): k for k, topic in enumerate(topics)} or {SENSOR_POSE: 0}
        self._came: list[list[Pose]] = [[] for _ in self._links]
        self.topics = list(self._links)
        self._next_stamp_s = -math.inf
        self._doubted_s = -math.inf  # until then small angles are taken to be in degrees
        super().__init__(context, endpoint, keys if keys and keys.robot else None)

    def poll(self, now_s: float, *, is_asked: bool = False) -> None:
        """Pass on what has come; where the loop `is_asked`, also that nothing has."""
        super().poll(now_s)
        if is_asked or any(self._came):
            self._on_poses(self._came, is_asked)
            self._came = [[] for _ in self._links]

    def look(self, now_s: float) -> None:
        was_connected = self.line.connected
        super().look(now_s)
        if self.line.connected and not was_connected:  # another publisher, or this one mended
            self._doubted_s = -math.inf
        if now_s >= self._next_stamp_s:
            self._next_stamp_s, self.is_awaited = now_s + STAMP_S, True

    def _take(self, now_s: float, parts: list[bytes]) -> None:
        link = self._links.get(parts[0])
        is_glued = len(parts) == 1 and parts[0].startswith(tuple(self._links))
        if link is None and not is_glued:  # its prefix is all that ZeroMQ looks at
            return
        pose = as_pose(parts)
        if pose == DEGREES:
            self._doubted_s = now_s + DEGREES_S
        elif now_s < self._doubted_s and not isinstance(pose, str):
            pose = DEGREES
        if isinstance(pose, str):
            self._bad(pose)
        else:
            self.is_awaited = False
            self._came[link or 0].append(pose)


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
