"""Each mistake with the sensor's pose has a line of its own, in status, health and the log."""

import itertools
from collections.abc import Callable
from typing import Any

import pytest

from taxeld.commands.status import lines
from taxeld.pipeline.pose_watch import PoseFault, PoseWatch, line
from taxeld.stream.link import RobotLine

NOW = 1_700_000_000.0
PERIOD_S = 0.05
ENDPOINT = "tcp://127.0.0.1:9874"
Told = tuple[float, float, float]  # t, x, y


def right(now: float) -> Told:
    return now - 0.002, 0.4, 0.1


def inputs(watch: PoseWatch) -> dict[str, Any]:
    return {f"poses_{name}": getattr(watch.figures, name) for name in watch.figures.__slots__}


def watched(
    told: Callable[[float], Told], rate_hz: float = 100.0, *, seconds: float = 8.0,
    late_s: float = 0.0,
) -> PoseWatch:  # fmt: skip
    """A watch over a robot that says what `told` makes of the time, looked at once a second."""
    watch = PoseWatch((0.0, 0.0), 0.5, PERIOD_S)
    sent = 0
    for second in itertools.count(1):
        while sent < rate_hz * min(second, seconds):
            now = NOW + sent / rate_hz
            watch.add(*told(now), now)
            sent += 1
        watch.look(NOW + second, 0, connected=True, refused=False, topics=0)
        if second >= seconds + late_s:
            return watch
    raise AssertionError


@pytest.mark.parametrize(
    ("told", "rate_hz", "late_s", "fault", "text"),
    [
        (right, 100.0, 0.0, PoseFault.NONE, ""),
        (right, 25.0, 0.0, PoseFault.NONE, ""),
        (lambda now: (now - 4.2, 0.4, 0.1), 100.0, 0.0, PoseFault.CLOCK,
         "the robot's clock is 4.2 s behind this machine's"),
        (lambda now: (now + 1.0, 0.4, 0.1), 100.0, 0.0, PoseFault.CLOCK,
         "the robot's clock is 1 s ahead of this machine's"),
        (lambda now: (1e3 * now, 0.4, 0.1), 100.0, 0.0, PoseFault.UNIT,
         "t is in milliseconds: send seconds"),
        (lambda now: (1e9 * now, 0.4, 0.1), 100.0, 0.0, PoseFault.UNIT,
         "t is in nanoseconds: send seconds"),
        (lambda now: (now - NOW + 5000.0, 0.4, 0.1), 100.0, 0.0, PoseFault.UPTIME,
         "t counts from the robot's start (a monotonic clock)"),
        (lambda now: (now, 400.0, 100.0), 100.0, 0.0, PoseFault.FAR,
         "the sensor is 412 m from where the object may be (filter.centre_m): are x and y in mil"),
        (right, 2.0, 0.0, PoseFault.SLOW, "2 poses/s are fewer than the 20 scans/s"),
        (right, 100.0, 5.0, PoseFault.STOPPED, "none for 5 s: the publisher at"),
    ],
)  # fmt: skip
def test_what_poses_say_tells_the_mistake(
    told: Callable[[float], Told], rate_hz: float, late_s: float, fault: PoseFault, text: str
) -> None:
    watch = watched(told, rate_hz, late_s=late_s)
    assert PoseFault(watch.figures.fault) is fault
    said = line(inputs(watch), NOW + 8.0, ENDPOINT, scans_hz=1.0 / PERIOD_S)
    assert said.startswith(text)
    assert bool(said) == bool(text)


def test_a_fault_stands_only_once_it_was_seen_twice() -> None:
    watch = PoseWatch((0.0, 0.0), 0.5, PERIOD_S)
    for _ in range(2):
        watch.add(NOW - 9.0, 0.4, 0.1, NOW)
    seen = []
    for second in range(2):
        watch.look(NOW + 0.1 * second, 0, connected=True, refused=False, topics=0)
        seen.append(PoseFault(watch.figures.fault))
    assert seen == [PoseFault.NONE, PoseFault.CLOCK]


def test_a_clock_that_was_set_is_no_fault_of_the_robot() -> None:
    watch = watched(right)
    watch.clock_stepped()
    for second in range(9, 12):
        now = NOW + second + 3600.0
        for k in range(100):
            watch.add(*right(now - 0.01 * k), now - 0.01 * k)
        watch.look(now, 0, connected=True, refused=False, topics=0)
        assert PoseFault(watch.figures.fault) is PoseFault.NONE


@pytest.mark.parametrize(
    ("line_of_the_door", "fault", "text"),
    [
        ({}, PoseFault.UNCONNECTED, f"nobody serves {ENDPOINT}: start the publisher; it binds"),
        ({"refused": True}, PoseFault.REFUSED,
         f"{ENDPOINT} takes the connection and refuses the daemon: robot.key must be the robot's"),
        ({"connected": True}, PoseFault.UNHEARD,
         f"connected to {ENDPOINT}, and nothing comes: publish /robot/sensor_pose"),
        ({"connected": True, "topics": ["/robot/sensorpose"]}, PoseFault.OTHER_TOPIC,
         f"connected to {ENDPOINT}, and only /robot/sensorpose comes: publish /robot/sensor_pose"),
        ({"connected": True, "malformed": 3}, PoseFault.MALFORMED,
         "messages come and are no poses: topic, then one msgpack map {t, x, y, theta}"),
    ],
    ids=["nobody serves", "refused", "says nothing", "another topic", "malformed"],
)  # fmt: skip
def test_where_no_pose_comes_the_connection_tells_the_mistake(
    line_of_the_door: dict[str, Any], fault: PoseFault, text: str
) -> None:
    robot = RobotLine(**line_of_the_door)
    watch = PoseWatch((0.0, 0.0), 0.5, PERIOD_S)
    for second in range(2):
        watch.look(
            NOW + second, robot.malformed, connected=robot.connected, refused=robot.refused,
            topics=len(robot.topics),
        )  # fmt: skip
    assert PoseFault(watch.figures.fault) is fault
    assert line(inputs(watch), NOW + 2.0, ENDPOINT, robot.topics).startswith(text)


def test_a_daemon_without_an_endpoint_says_that_its_sensor_stands_still() -> None:
    answer = _answer(PoseWatch((0.0, 0.0), 0.5, PERIOD_S))
    answer["sensor_pose"] = {"endpoint": "", "topics": []}
    rows = dict(row.split(": ", maxsplit=1) for row in lines(answer))
    assert rows["Sensor poses  "] == "sensor_pose.endpoint is empty: the sensor stands still"
    assert not any(name.startswith("Pose ") and "fault" in name for name in rows)


def test_status_has_how_the_poses_come_and_what_is_wrong() -> None:
    answer = _answer(watched(lambda now: (now - 4.2, 0.4, 0.1)))
    answer["sensor_pose"] = {"endpoint": ENDPOINT, "topics": []}
    rows = dict(row.split(": ", maxsplit=1) for row in lines(answer))
    assert rows["Pose link     "] == f"connected to {ENDPOINT}"
    assert rows["Pose timing   "].startswith("100 a second, the last 0.01 s ago, their time 4.2 s ")
    assert rows["Pose fault    "].startswith("the robot's clock is 4.2 s behind this machine's")
    del answer["sensor_pose"]  # as before the first health
    rows = dict(row.split(": ", maxsplit=1) for row in lines(answer))
    assert rows["Pose link     "] == "connected"
    assert rows["Pose fault    "].startswith("the robot's clock is 4.2 s behind this machine's")


def _answer(watch: PoseWatch) -> dict[str, Any]:
    """An answer to `status`, of the documented example."""
    from .test_stream_document import documented  # noqa: PLC0415

    health = documented("/taxeld/health")[1]
    health["t"] = NOW + 8.0
    health["inputs"] |= inputs(watch)
    return {"estimate": documented("/taxeld/estimate")[1], "health": health}
