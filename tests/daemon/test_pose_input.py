"""The robot's sensor poses: its own, whole, and no matter what comes between them."""

import time
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.stream import messages
from taxeld.stream.pose_input import PoseInput

from .conftest import Sockets


class Robot:
    """A robot and the input that hears it; its poses are numbered by their x."""

    def __init__(self, sockets: Sockets, place: Path) -> None:
        self.taken: list[float] = []
        self.socket: zmq.Socket[Any] = sockets.open(zmq.PUB)
        self.socket.bind(f"ipc://{place}/poses")
        self.input = PoseInput(
            sockets.context, f"ipc://{place}/poses", lambda _t, x, *_: self.taken.append(x)
        )
        sockets.callback(self.input.close)

    def send(self, x: float, topic: bytes = messages.SENSOR_POSE) -> None:
        body = msgpack.packb({"t": 1.0, "x": x, "y": 0.0, "theta": 0.0})
        self.socket.send_multipart([topic, body, b"1.0"])

    def until_heard(self, x: float) -> None:
        deadline = time.monotonic() + 10.0
        while x not in self.taken:
            assert time.monotonic() < deadline, "no pose comes"
            self.send(x)
            self.input.poll()
            time.sleep(0.001)


@pytest.fixture
def robot(sockets: Sockets, tmp_path: Path) -> Robot:
    made = Robot(sockets, tmp_path)
    made.until_heard(0.0)
    return made


def test_the_poses_of_another_arm_are_not_taken(robot: Robot) -> None:
    for name in (b"_left_arm", b"/left", b"s"):
        robot.send(9.0, messages.SENSOR_POSE + name)
    robot.until_heard(1.0)
    assert set(robot.taken) == {0.0, 1.0}
    assert robot.input.counters.malformed == 0


def test_messages_of_very_many_frames_starve_no_pose(robot: Robot) -> None:
    """Read to their end, a hundred of them would take hundreds of ticks."""
    long = [messages.SENSOR_POSE, *[b"x"] * 5000]
    for _ in range(100):
        robot.socket.send_multipart(long)
    robot.taken.clear()
    polls = 0
    while not robot.taken:
        robot.send(1.0)
        robot.input.poll()
        time.sleep(0.01)
        polls += 1
        assert polls < 300
    assert robot.input.counters.oversized >= 1
    assert robot.input.counters.malformed == 0
