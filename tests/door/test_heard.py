"""The robot's poses through the door: whole, whatever else is published beside them."""

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.door import heard
from taxeld.door.heard import REASON_MAX, as_pose

from ..rig.processes import attacked
from .stand import Stand, pose, robots_endpoint


class Robot:
    """A robot, and the door that hears it; its poses are numbered by their x."""

    def __init__(self, stand: Stand, endpoint: str) -> None:
        self.stand, self.endpoint = stand, endpoint
        self.socket = stand.socket(zmq.PUB)

    def until_heard(self, x: float) -> None:
        def comes() -> bool:
            self.socket.send_multipart(pose(x))
            return any(p[1] == x for p in self.stand.poses)

        self.stand.until(comes)

    @property
    def line(self) -> Any:
        return self.stand.link.report.robot


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    endpoint = robots_endpoint()
    with Stand(tmp_path, robot=endpoint) as stand:
        made = Robot(stand, endpoint)
        made.socket.bind(endpoint)
        made.until_heard(0.0)
        yield made


def test_poses_come_by_the_topics_of_the_links_alone(tmp_path: Path) -> None:
    endpoint, topics = robots_endpoint(), ("/robot/sensor_pose", "/robot/wrist")
    with Stand(tmp_path, robot=endpoint, topics=topics) as stand:
        robot = Robot(stand, endpoint)
        robot.socket.bind(endpoint)
        robot.until_heard(0.0)
        for name in (b"_left_arm", b"/left", b"s"):
            robot.socket.send_multipart([b"/robot/sensor_pose" + name, *pose(9.0)[1:]])
        robot.socket.send_multipart([b"/robot/wrist", *pose(7.0)[1:]])
        stand.until(lambda: bool(stand.further))
        robot.until_heard(1.0)
    assert [p[1] for p in stand.further] == [7.0]
    assert {p[1] for p in stand.poses} == {0.0, 1.0}
    assert robot.line.malformed == 0


def test_a_door_is_not_woken_by_each_pose(robot: Robot) -> None:
    def sleeps() -> int:
        status = Path(f"/proc/{robot.stand.pid}/status").read_text(encoding="ascii")
        return int(status.partition("\nvoluntary_ctxt_switches:")[2].split()[0])

    before, count = sleeps(), 1000
    for number in range(1, count + 1):
        robot.socket.send_multipart(pose(float(number)))
        time.sleep(0.001)
        robot.stand.look()
    robot.stand.until(lambda: robot.stand.poses[-1][1] == count)
    assert len(robot.stand.poses) >= count
    assert sleeps() - before < count / 4


@pytest.mark.check
def test_a_large_message_beside_the_poses_does_not_end_them(robot: Robot) -> None:
    """After an error of the protocol ZeroMQ does not connect again by itself."""
    robot.socket.send_multipart([b"/robot/sensor_pose_history", bytes(200_000)])
    robot.until_heard(2.0)
    robot.stand.until(lambda: robot.line.connected)


@pytest.mark.check
def test_another_service_on_the_port_for_a_moment_does_not_end_the_poses(tmp_path: Path) -> None:
    endpoint = robots_endpoint()
    with Stand(tmp_path, robot=endpoint) as stand:
        with attacked("nonsense", endpoint):
            stand.until(lambda: stand.link.report.robot.refused)
        made = Robot(stand, endpoint)
        stand.until_bound(made.socket, endpoint)
        made.until_heard(1.0)


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
    ],
)
def test_a_message_that_is_no_pose_has_a_reason_of_its_own(parts: list[bytes], reason: str) -> None:
    said = as_pose(parts)
    assert isinstance(said, str)
    assert said.startswith(reason)


def test_an_angle_of_a_turn_and_a_half_is_an_angle_in_radians() -> None:
    assert as_pose(sent(theta=9.42)) == (1.0, 0.0, 0.0, 9.42)


@pytest.mark.check
def test_a_robot_that_once_sent_degrees_is_not_heard_at_small_angles_until_it_comes_anew(
    robot: Robot,
) -> None:
    def is_refused(**changes: object) -> None:
        before = robot.line.malformed

        def comes() -> bool:
            robot.socket.send_multipart(sent(**changes))
            return bool(robot.line.malformed > before + 20)

        robot.stand.until(comes)

    is_refused(theta=90.0)
    is_refused(x=5.0, theta=1.0)
    assert robot.line.reason.startswith("theta is beyond 1.5 turns")
    robot.socket.close()
    robot.stand.until(lambda: not robot.line.connected)
    again = Robot(robot.stand, robot.endpoint)
    robot.stand.until_bound(again.socket, robot.endpoint)
    again.until_heard(6.0)
    assert 5.0 not in {x for _, x, *_ in robot.stand.poses}


def test_the_loop_hears_why_a_message_is_no_pose_in_one_printable_line(robot: Robot) -> None:
    def hears() -> str:
        robot.socket.send_multipart(sent({"\x1b]0;x\n" * 30: 1.0}))
        return str(robot.line.reason)

    robot.stand.until(hears)
    assert robot.line.malformed > 0
    assert robot.line.reason.startswith("key t lacks; the map has \\x1b]0;x\\n")
    assert robot.line.reason.isprintable()
    assert len(robot.line.reason) <= REASON_MAX


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
