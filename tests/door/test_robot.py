"""The robot's poses through the door: whole, whatever else is published beside them."""

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from zmq.auth import create_certificates, load_certificate

from taxeld.door.robot import as_pose

from . import attacks
from .stand import ANYWHERE, PATIENCE_S, Stand, pose, program, resident_bytes, robots_endpoint


class Robot:
    """A robot, and the door that hears it; its poses are numbered by their x."""

    def __init__(self, stand: Stand, endpoint: str) -> None:
        self.stand, self.endpoint = stand, endpoint
        self.socket = stand.robot()

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


def test_the_poses_of_another_arm_are_not_taken(robot: Robot) -> None:
    for name in (b"_left_arm", b"/left", b"s"):
        robot.socket.send_multipart([b"/robot/sensor_pose" + name, *pose(9.0)[1:]])
    robot.until_heard(1.0)
    assert {p[1] for p in robot.stand.poses} == {0.0, 1.0}
    assert robot.line.malformed == 0


def test_messages_of_very_many_frames_starve_no_pose(robot: Robot) -> None:
    for _ in range(100):
        robot.socket.send_multipart([b"/robot/sensor_pose", *[b"x"] * 5000])
    robot.until_heard(1.0)
    robot.stand.until(lambda: robot.line.oversized)
    assert robot.line.malformed == 0


@pytest.mark.parametrize("size", [2_000, 200_000])
def test_a_large_message_beside_the_poses_does_not_end_them(robot: Robot, size: int) -> None:
    """After an error of the protocol ZeroMQ does not connect again by itself."""
    robot.socket.send_multipart([b"/robot/sensor_pose_history", bytes(size)])
    robot.until_heard(2.0)
    robot.stand.until(lambda: robot.line.connected)


def test_another_service_on_the_port_for_a_moment_does_not_end_the_poses(tmp_path: Path) -> None:
    endpoint = robots_endpoint()
    with Stand(tmp_path, robot=endpoint) as stand:
        with program(attacks.NONSENSE, endpoint.rpartition(":")[2]):
            stand.until(lambda: stand.link.report.robot.refused)
        made = Robot(stand, endpoint)
        stand.until_bound(made.socket, endpoint)
        made.until_heard(1.0)


def test_a_false_robot_that_sends_without_end_costs_subscribers_nothing(tmp_path: Path) -> None:
    """Any local user can bind the robot's port while the robot is not there."""
    endpoint = robots_endpoint()
    with Stand(tmp_path, robot=endpoint) as stand:
        door, honest = stand.pid, stand.subscriber(b"/taxeld/e")
        lost = stand.losses(honest)
        with program(attacks.ENDLESS_POSE, endpoint.rpartition(":")[2]):
            stand.until(lambda: stand.link.report.hoarders >= 3)
            assert resident_bytes(door) < 160 << 20
            for _ in range(20):
                stand.received(honest)
        assert stand.pid == door
        assert not lost.poll(0)


@pytest.mark.parametrize(
    "body",
    [
        b"", b"\xc0", msgpack.packb([1.0] * 4), msgpack.packb({"t": 1.0, "x": 0.0, "y": 0.0}),
        msgpack.packb({"t": "1", "x": 0.0, "y": 0.0, "theta": 0.0}),
        msgpack.packb({"t": 1.0, "x": float("nan"), "y": 0.0, "theta": 0.0}),
        msgpack.packb({"t": [], "x": 0.0, "y": 0.0, "theta": 0.0}),
    ],
    ids=["empty", "nil", "list", "lacks", "text", "nan", "nested"],
)  # fmt: skip
def test_a_message_that_is_no_pose_is_none(body: bytes) -> None:
    assert as_pose([b"/robot/sensor_pose", body, b"1.0"]) is None
    assert as_pose(pose(1.0)[:2]) is None


def said(stand: Stand, holds: Callable[[Any], object], between: Callable[[], None]) -> None:
    """Until the door's report on the robot is so."""

    def reported() -> bool:
        between()
        return bool(holds(stand.link.report.robot))

    stand.until(reported, PATIENCE_S)


def test_what_else_the_robot_publishes_is_named_while_no_pose_comes(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/poses"
    with Stand(tmp_path, robot=endpoint) as stand:
        robot = stand.robot()
        robot.bind(endpoint)
        hostile = [b"/robot/sensorpose\n<0>\x1b]0;x", b"x", b"1.0"]
        said(stand, lambda line: line.topics, lambda: robot.send_multipart(hostile))
        (topic,) = stand.link.report.robot.topics
        assert topic.isprintable()
        assert topic.startswith("/robot/sensorpose\\n")
        said(stand, lambda line: not line.topics, lambda: robot.send_multipart(pose(1.0)))


def test_a_robot_with_other_keys_is_told_as_one_that_refuses(tmp_path: Path) -> None:
    pairs = {}
    keys = tmp_path / "keys"
    keys.mkdir()
    for name in ("server", "robot", "stranger"):
        create_certificates(keys, name)
        (keys / f"{name}.key_secret").chmod(0o600)
        pairs[name] = load_certificate(keys / f"{name}.key_secret")
    (keys / "robot.key").write_bytes((keys / "stranger.key").read_bytes())
    endpoint = robots_endpoint(ANYWHERE)
    with Stand(tmp_path, robot=endpoint, keys=str(keys)) as stand:
        robot = stand.robot()
        robot.setsockopt(zmq.CURVE_SERVER, 1)
        secret = pairs["robot"][1]
        assert secret is not None
        robot.setsockopt(zmq.CURVE_SECRETKEY, secret)
        robot.bind(endpoint)
        said(stand, lambda line: line.refused, lambda: None)


def test_poses_that_the_loop_does_not_fetch_are_counted(robot: Robot) -> None:
    for number in range(2000):
        robot.socket.send_multipart(pose(float(number)))
    os.sched_yield()
    robot.until_heard(-1.0)
    robot.stand.until(lambda: robot.stand.link.report.poses_lost + len(robot.stand.poses) > 1000)
    assert struct.calcsize("4d") == 32
