"""A mistake with the sensor's pose is named with its cure, in status and in the log."""

import itertools
import re
from collections.abc import Callable
from typing import Any

import pytest

from taxeld.commands.status import lines
from taxeld.service.inputs import PoseWatch
from taxeld.stream.link import PeerLine

from .test_stream_document import documented

NOW = 1_700_000_000.0
PERIOD_S = 0.05
ENDPOINT = "tcp://127.0.0.1:9874"
Told = Callable[[float], float]


def right(now: float) -> float:
    return now - 0.002


def look(watch: PoseWatch, now: float, **line: Any) -> None:
    is_heard = line.pop("is_heard", True)
    watch.look(now, PeerLine(**{"connected": True} | line), is_heard=is_heard)


def watched(told: Told, rate_hz: float = 100.0, late_s: float = 0.0) -> PoseWatch:
    """A watch, looked at once a second, over a robot that sends poses of the times `told` for
    eight seconds."""
    watch = PoseWatch(ENDPOINT, PERIOD_S)
    sent = 0
    for second in itertools.count(1):
        while sent < rate_hz * min(second, 8.0):
            now = NOW + sent / rate_hz
            watch.add(told(now), now)
            sent += 1
        look(watch, NOW + second)
        if second >= 8.0 + late_s:
            return watch
    raise AssertionError


@pytest.mark.parametrize(
    ("told", "rate_hz", "late_s", "fault"),
    [
        (right, 100.0, 0.0, ""),
        (right, 25.0, 0.0, ""),
        (lambda now: now - 4.2, 100.0, 0.0, "their times are not of this machine's clock"),
        (lambda now: 1e3 * now, 100.0, 0.0, "their times are not of this machine's clock"),
        (lambda now: now - NOW, 100.0, 0.0, "their times are not of this machine's clock"),
        (right, 2.0, 0.0, "fewer poses than scans come: publish 100 a second"),
        (right, 100.0, 5.0, f"connected to {ENDPOINT}, and no pose comes: publish"),
    ],
)
def test_poses_tell_the_mistake(told: Told, rate_hz: float, late_s: float, fault: str) -> None:
    found = watched(told, rate_hz, late_s).fault
    assert found.startswith(fault)
    assert bool(found) == bool(fault)


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ({"connected": False}, f"nobody serves {ENDPOINT}: start the publisher; it binds"),
        ({"refused": True}, f"{ENDPOINT} refuses the daemon: both must use keys, or neither"),
        ({}, f"connected to {ENDPOINT}, and no pose comes: publish /robot/sensor_pose"),
    ],
)
def test_without_poses_the_connection_tells_the_mistake_also_while_the_door_is_not_heard(
    line: dict[str, Any], fault: str
) -> None:
    watch = PoseWatch(ENDPOINT, PERIOD_S)
    for second in range(3):
        look(watch, NOW + second, **line)
    assert watch.fault.startswith(fault)
    look(watch, NOW + 3.0, is_heard=False)
    assert watch.fault.startswith(fault)


@pytest.mark.parametrize("is_far", [True, False])
def test_messages_that_are_no_poses_or_in_millimetres_are_a_fault_while_they_come(
    is_far: bool,
) -> None:
    watch, faults = watched(right), list[str]()
    for k, n in enumerate((3, 6, 9, 9)):
        watch.add(NOW, NOW, is_far=is_far and k < 3)
        malformed = 0 if is_far else n
        faults.append(heard(watch, NOW + 9.0 + k, malformed=malformed, reason="t is no number"))
    said = "messages come and are no poses: t is no number"
    if is_far:
        said = "x or y is beyond 10 m: send metres, not millimetres"
    assert faults == ["", "", said, ""]


def heard(watch: PoseWatch, now: float, **line: Any) -> str:
    """The fault after another second of right poses."""
    for k in range(100):
        watch.add(right(now - 0.01 * k), now - 0.01 * k)
    look(watch, now, **line)
    return watch.fault


def test_a_machine_that_is_late_now_and_then_is_no_fault_of_the_robots_clock() -> None:
    watch = PoseWatch(ENDPOINT, PERIOD_S)
    for second in range(40):
        late_s = 0.002 if second % 5 == 4 else 0.4
        watch.add(NOW + second - late_s, NOW + second)
        look(watch, NOW + second)
        assert "times" not in watch.fault


def test_a_clock_that_was_set_is_no_fault_of_the_robot() -> None:
    watch = watched(right)
    watch.clock_stepped()
    assert [heard(watch, NOW + 3600.0 + second) for second in range(9, 12)] == [""] * 3


def rows_of(**answer: Any) -> dict[str, str]:
    """The rows of an answer that is as documented but for this."""
    usual = {name: documented(f"/taxeld/{name}")[1] for name in ("estimate", "health")}
    return dict(re.split(r" *: ", row, maxsplit=1) for row in lines(usual | answer))


def test_status_has_how_the_poses_come_and_what_is_wrong() -> None:
    watch = watched(lambda now: now - 4.2)
    timing = {"rate_hz": watch.rate_hz, "age_s": watch.age_s, "offset_s": watch.offset_s}
    health = documented("/taxeld/health")[1]
    health["inputs"] |= {f"poses_{name}": value for name, value in timing.items()}
    assert rows_of(health=health)["Sensor poses"] == "500 used"  # as before the first health
    wrong = {"endpoint": ENDPOINT, "fault": watch.fault}
    rows = rows_of(health=health, sensor_pose=wrong)
    assert rows["Sensor poses"] == f"500 used, from {ENDPOINT}"
    late = "100 a second, the last 0.01 s ago, their time 4.2 s "
    assert rows["Pose timing"] == f"{late}behind this clock"
    assert rows["Pose fault"] == watch.fault
    health["inputs"]["poses_offset_s"] *= -1.0
    still = rows_of(health=health, sensor_pose={"endpoint": "", "fault": ""})
    assert rows_of(health=health)["Pose timing"] == f"{late}ahead of this clock"
    assert still["Sensor poses"] == "sensor_pose.endpoint is empty: the sensor stands still"
    assert "Pose fault" not in still
