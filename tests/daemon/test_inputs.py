"""The loop sleeps until its device or the door has something to say: descriptors come and go."""

import os
import threading
import time
from collections.abc import Iterator

import pytest

from taxeld.service.inputs import Inputs, Ready

SOON_S = 20.0  # a wait that ends by what comes ends long before


class Pipe:
    """A descriptor that is readable after `say`."""

    def __init__(self) -> None:
        self._out, self._in = os.pipe()
        self.is_open = True

    def fileno(self) -> int:
        return self._out

    def say(self) -> None:
        os.write(self._in, b"x")

    def hear(self) -> None:
        os.read(self._out, 100)

    def close(self) -> None:
        if self.is_open:
            os.close(self._out)
            os.close(self._in)
        self.is_open = False


@pytest.fixture
def pipes() -> Iterator[list[Pipe]]:
    made = [Pipe() for _ in range(4)]
    yield made
    for pipe in made:
        pipe.close()


@pytest.fixture
def inputs() -> Iterator[Inputs]:
    made = Inputs()
    yield made
    made.close()


def wait(inputs: Inputs, seconds: float = SOON_S) -> Ready:
    return inputs.wait(time.monotonic() + seconds)


def test_whoever_speaks_ends_the_wait_and_is_named(inputs: Inputs, pipes: list[Pipe]) -> None:
    device, robot, *_ = pipes
    inputs.follow(device, robot)
    assert wait(inputs, 0.0) == Ready()
    for pipe, ready in (
        (device, Ready(device=True)), (robot, Ready(robot=True)),
    ):  # fmt: skip
        pipe.say()
        assert wait(inputs) == ready
        pipe.hear()
        assert wait(inputs, 0.0) == Ready()


def test_what_comes_while_it_sleeps_wakes_it(inputs: Inputs, pipes: list[Pipe]) -> None:
    inputs.follow(pipes[0], None)
    speaker = threading.Timer(0.05, pipes[0].say)
    speaker.start()
    assert wait(inputs) == Ready(device=True)
    speaker.join()


def test_a_robot_that_no_scan_waits_for_does_not_wake_it(inputs: Inputs, pipes: list[Pipe]) -> None:
    device, robot, *_ = pipes
    robot.say()
    inputs.follow(device, robot)
    assert wait(inputs) == Ready(robot=True)
    inputs.follow(device, None)
    assert wait(inputs, 0.0) == Ready()
    inputs.follow(device, robot)  # what it said is still there
    assert wait(inputs) == Ready(robot=True)


def test_a_device_that_came_back_under_its_old_number_is_heard(
    inputs: Inputs, pipes: list[Pipe]
) -> None:
    first, robot, *_ = pipes
    inputs.follow(first, robot)
    number = first.fileno()
    first.close()
    again = Pipe()
    try:
        assert again.fileno() == number
        inputs.follow(again, robot)
        again.say()
        assert wait(inputs) == Ready(device=True)
        inputs.follow(None, robot)
        assert wait(inputs, 0.0) == Ready()
    finally:
        again.close()


def test_two_that_have_changed_places_are_both_heard(inputs: Inputs, pipes: list[Pipe]) -> None:
    """As when a device and the robot's socket are opened anew between two waits."""
    first, second, *_ = pipes
    inputs.follow(first, second)
    inputs.follow(second, first)
    second.say()
    assert wait(inputs) == Ready(device=True)
    first.say()
    assert wait(inputs) == Ready(device=True, robot=True)


def test_a_device_without_a_descriptor_is_left_to_the_clock(inputs: Inputs) -> None:
    class Mute:
        @staticmethod
        def fileno() -> int:
            return -1

    inputs.follow(Mute(), None)
    assert wait(inputs, 0.001) == Ready()


def test_a_device_that_rests_wakes_nobody_and_others_do(inputs: Inputs, pipes: list[Pipe]) -> None:
    device, robot, *_ = pipes
    inputs.follow(device, robot)
    device.say()
    assert inputs.rest(time.monotonic() + 0.001) == Ready()
    robot.say()
    assert inputs.rest(time.monotonic() + SOON_S) == Ready(robot=True)
    assert wait(inputs) == Ready(device=True, robot=True), "what it has said is still there"
