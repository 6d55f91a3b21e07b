"""Poses and arrays through the door: whole, whatever else is published beside them."""

import json
import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.door import heard
from taxeld.door.heard import REASON_MAX, as_pose
from taxeld.service.inputs import OFFSET_S
from taxeld_protocol.array import REST, ArrayFrame

from ..rig.processes import attacked
from .stand import Stand, pose, robots_endpoint


class Publisher:
    """A robot, or a skin that sends arrays, whose messages are numbered; and the door that hears
    it."""

    def __init__(self, place: Path, kind: str, endpoint: str, **settings: Any) -> None:
        self.stand = Stand(place, **{kind: endpoint}, **settings)
        self.endpoint, self._kind = endpoint, kind
        self.arrays: list[ArrayFrame] = []
        self.stand.link.on_array = self.arrays.append
        self.socket = self.publish()

    @property
    def numbers(self) -> list[float]:
        """Of what was heard: a pose's x, an array's time."""
        return [pose[1] for pose in self.stand.poses] + [frame.t for frame in self.arrays]

    @property
    def line(self) -> Any:
        return getattr(self.stand.link.report, self._kind)

    def publish(self) -> zmq.Socket[Any]:
        made = self.stand.socket(zmq.PUB, SNDHWM=0)
        self.stand.until_bound(made, self.endpoint)
        return made

    def until_heard(self, number: float, *frames: bytes) -> None:
        """`frames` are sent until they come, by default an ordinary message of that number."""
        ordinary = pose(number) if self._kind == "robot" else [b"/skin/a", packed(number), b"1.0"]
        self.stand.send_until(lambda: number in self.numbers, self.socket, *(frames or ordinary))


def packed(number: float) -> bytes:
    """An array."""
    return msgpack.packb({"t": number, "id": "a", "z": [0.0, 1.0]})  # type: ignore[no-any-return]


KINDS = "robot", "skin by ipc", "skin by tcp"


@pytest.fixture(params=KINDS)
def publisher(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Publisher]:
    kind, endpoint = "array", robots_endpoint()
    if request.param == KINDS[0]:
        kind = "robot"
    elif request.param == KINDS[1]:
        endpoint = f"ipc://{tmp_path}/skin"
    made = Publisher(tmp_path, kind, endpoint)
    with made.stand:
        made.until_heard(0.0)
        yield made


robots = pytest.mark.parametrize("publisher", KINDS[:1], indirect=True)
skins = pytest.mark.parametrize("publisher", KINDS[1:], indirect=True)


def test_one_who_comes_anew_is_heard_and_by_a_new_door_too(publisher: Publisher) -> None:
    publisher.socket.close()
    publisher.socket = publisher.publish()
    publisher.until_heard(1.0)
    os.kill(publisher.stand.pid, signal.SIGKILL)
    publisher.stand.until(lambda: publisher.stand.keeper.starts == 2)
    publisher.until_heard(2.0)


@pytest.mark.check
def test_a_large_message_costs_the_connection_which_comes_back(publisher: Publisher) -> None:
    """After an error of the protocol ZeroMQ does not connect again by itself."""
    for number, topic in enumerate((b"/robot/sensor_pose_history", b"/skin"), 1):
        publisher.socket.send_multipart([topic, bytes(10_000_000)])
        publisher.socket.send_multipart([topic] * 5000)
        publisher.until_heard(number)
    publisher.stand.until(lambda: publisher.line.connected)
    assert publisher.stand.keeper.starts == 1


@skins
def test_arrays_come_as_msgpack_and_json_with_a_topic_or_alone(publisher: Publisher) -> None:
    publisher.until_heard(1.0, packed(1.0))
    publisher.until_heard(2.0, json.dumps(msgpack.unpackb(packed(2.0))).encode())
    assert {frame[1:] for frame in publisher.arrays} == {("a", REST, (REST, REST + 20_000))}
    publisher.stand.until(lambda: publisher.line.connected)
    assert publisher.line.malformed == 0


BOMBS = [
    b"",
    b"\x00",
    b"[" * 60_000,
    b'{"t":' * 10_000,
    b'{"t":' + b"9" * 60_000 + b"}",
    b"\x91" * 60_000,
    msgpack.packb({"t": 1.0, "id": "a"}),
    msgpack.packb({"t": 1.0, "id": "a", "z": [float("nan")]}),
]


@skins
def test_bad_arrays_are_counted_with_a_reason_and_cost_no_other(publisher: Publisher) -> None:
    for number, bomb in enumerate(BOMBS, 1):
        publisher.socket.send_multipart([b"/skin", bomb])
        publisher.socket.send(packed(number))
    publisher.stand.until(lambda: publisher.numbers[-1] == len(BOMBS))
    assert [number for number in publisher.numbers if number] == list(range(1, len(BOMBS) + 1))
    publisher.stand.until(lambda: publisher.line.malformed == len(BOMBS))
    assert publisher.line.reason.startswith("z has values that are not from")


def test_poses_come_by_the_topics_of_the_links_alone(tmp_path: Path) -> None:
    topics = ("/robot/sensor_pose", "/robot/wrist")
    robot = Publisher(tmp_path, "robot", robots_endpoint(), topics=topics)
    with robot.stand as stand:
        robot.until_heard(0.0)
        for name in (b"_left_arm", b"/left", b"s"):
            robot.socket.send_multipart([b"/robot/sensor_pose" + name, *pose(9.0)[1:]])
        robot.until_heard(7.0, b"/robot/wrist", *pose(7.0)[1:])
        robot.until_heard(1.0)
    assert {(x, link) for _, x, *_, link in stand.poses} == {(0.0, 0), (7.0, 1), (1.0, 0)}
    assert robot.line.malformed == 0


@robots
def test_a_pose_comes_when_it_is_sent_however_late_the_loop_looks(publisher: Publisher) -> None:
    """At least once a second: the door finds the others when it looks."""
    for _ in range(40):
        publisher.socket.send_multipart(sent(t=time.time()))
        time.sleep(0.2)
        publisher.stand.look()
    assert min(came - t for t, *_, came, _ in publisher.stand.poses) < OFFSET_S


def test_once_a_second_a_pose_is_awaited() -> None:
    with zmq.Context() as context:
        robot, awaited = heard.Robot(context, robots_endpoint(), lambda *_: None, None), []
        for now_s in (0.0, 0.5, 1.0, 1.5):
            robot.look(now_s)
            awaited.append(robot.is_awaited)
            robot.is_awaited = False
        context.destroy(linger=0)
    assert awaited == [True, False, True, False]


@robots
def test_a_door_is_not_woken_by_each_pose(publisher: Publisher) -> None:
    def sleeps() -> int:
        status = Path(f"/proc/{publisher.stand.pid}/status").read_text(encoding="ascii")
        return int(status.partition("\nvoluntary_ctxt_switches:")[2].split()[0])

    before, count = sleeps(), 1000
    for number in range(1, count + 1):
        publisher.socket.send_multipart(pose(float(number)))
        time.sleep(0.001)
        publisher.stand.look()
    publisher.stand.until(lambda: publisher.stand.poses[-1][1] == count)
    assert len(publisher.stand.poses) >= count
    assert sleeps() - before < count / 4


@pytest.mark.check
@robots
def test_another_service_on_the_port_does_not_end_the_poses(
    publisher: Publisher,
) -> None:
    publisher.socket.close()
    with attacked("nonsense", publisher.endpoint):
        publisher.stand.until(lambda: publisher.line.refused)
    publisher.socket = publisher.publish()
    publisher.until_heard(1.0)


def sent(body: object = None, **changes: object) -> list[bytes]:
    """A message whose map is `body`, or a good one with changes."""
    if not isinstance(body, bytes):
        body = msgpack.packb(body or {"t": 1.0, "x": 0.0, "y": 0.0, "theta": 0.0} | changes)
    return [b"/robot/sensor_pose", body, b"1.0"]


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        (pose(1.0)[:2], "they have 2 frames: send three, the topic, one msgpack map, the time"),
        ([b"".join(pose(1.0)[:2])], "topic and map are one frame: send three, "),
        (sent(b""), "the second frame is no msgpack map {t, x, y, theta}"),
        (sent(b"\xc0"), "the second frame is no msgpack map"),
        (sent([1.0] * 4), "the second frame is no msgpack map"),
        (sent(b'{"t": 1.0, "x": 0, "y": 0, "theta": 0}'), "the map is JSON: pack it by msgpack"),
        (sent({"y": 0.0, "x": 0.0, "t": 1.0, "yaw": 0}), "key theta lacks; the map has t, x, y, y"),
        (sent(t="1"), "t is no number"),
        (sent(y=None), "y is no number"),
        (sent(x=math.nan), "x is not finite: leave such a pose out"),
        (sent(theta=-math.inf), "theta is not finite: leave such a pose out"),
        (sent(theta=90.0), "theta is beyond 1.5 turns: send radians from -pi to pi, not"),
        (sent(theta=-9.43), "theta is beyond 1.5 turns: send radians"),
        (sent(theta=9.42), "(1.0, 0.0, 0.0, 9.42)"),
    ],
)
def test_a_message_that_is_no_pose_has_a_reason_of_its_own(parts: list[bytes], reason: str) -> None:
    assert str(as_pose(parts)).startswith(reason)


@pytest.mark.check
@robots
def test_a_robot_that_once_sent_degrees_is_not_heard_at_small_angles_until_it_comes_anew(
    publisher: Publisher,
) -> None:
    def is_refused(**changes: object) -> None:
        enough = publisher.line.malformed + 20
        publisher.stand.send_until(
            lambda: publisher.line.malformed > enough, publisher.socket, *sent(**changes)
        )

    is_refused(theta=90.0)
    is_refused(x=5.0, theta=1.0)
    assert publisher.line.reason.startswith("theta is beyond 1.5 turns")
    publisher.socket.close()
    publisher.stand.until(lambda: not publisher.line.connected)
    publisher.socket = publisher.publish()
    publisher.until_heard(6.0)
    assert 5.0 not in publisher.numbers


@robots
def test_the_loop_hears_why_a_message_is_no_pose_in_a_line(
    publisher: Publisher,
) -> None:
    message = sent({"\x1b]0;x\n" * 30: 1.0})
    publisher.stand.send_until(lambda: publisher.line.reason, publisher.socket, *message)
    assert publisher.line.malformed > 0
    assert publisher.line.reason.startswith("key t lacks; the map has \\x1b]0;x\\n")
    assert publisher.line.reason.isprintable()
    assert len(publisher.line.reason) <= REASON_MAX


def test_a_robot_that_stays_away_stops_nothing_else(tmp_path: Path) -> None:
    with zmq.Context() as context:
        robot = heard.Robot(context, "tcp://127.0.0.1:9", lambda *_: None, None)
        for k in range(1500):
            robot.look(time.monotonic() + 2.0 * heard.AGAIN_S)
            time.sleep((0.0002, 0.0005, 0.001)[k % 3])
        served, client = context.socket(zmq.XPUB), context.socket(zmq.SUB)
        served.bind(f"ipc://{tmp_path / 'served'}")
        client.subscribe(b"")
        client.connect(f"ipc://{tmp_path / 'served'}")
        assert served.poll(10_000)
        context.destroy(linger=0)
