"""Faults of the robot's poses, from their times of arrival and their contents.

A robot that is not heard, another clock and another unit all end in scans without a pose; each has
its own cure. Every message of the topic is looked at, whether its pose is used or not.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

LOOKS = 5  # looks, a second each, over which the rate is taken
OFFSET_S = 0.05  # s between the robot's clock and this one
UPTIME_S = 3.2e8  # ten years: a smaller time counts from the robot's start, not from 1970
UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
SPREAD = 1.5  # factor within which a time matches one of these units
SLOW = 0.9  # share of the scans' rate: fewer poses are too few
STOPPED_S = 1.0  # s without a pose after which they have stopped
FAR_WIDTHS = 10.0  # half widths of the object's square: a farther pose is in a wrong unit
FAR_M = 10.0  # least distance that counts as too far
NEVER_S = -1.0  # age reported before the first pose


class PoseFault(IntEnum):
    """The gravest fault of the sensor's poses."""

    NONE = 0
    UNCONNECTED = 1  # nobody serves the endpoint
    REFUSED = 2  # the peer refuses this client, or is no ZeroMQ publisher
    OTHER_TOPIC = 3  # connected; messages of other topics come, and no pose
    UNHEARD = 4  # connected; nothing comes
    MALFORMED = 5  # messages of the topic are no poses
    UPTIME = 6  # times count from the robot's start
    UNIT = 7  # times are in ms, µs or ns
    CLOCK = 8  # the clocks differ
    FAR = 9  # poses are too far, as if in millimetres
    SLOW = 10  # fewer poses than scans
    STOPPED = 11  # poses came before, and come no more


@dataclass(slots=True)
class PoseFigures:
    """Figures of the last looks; part of health."""

    received: int = 0  # messages of the topic, since start
    rate_hz: float = 0.0
    age_s: float = NEVER_S  # time since the last pose
    offset_s: float = 0.0  # least delay of the poses' times behind this clock in the last second
    reach_m: float = 0.0  # least distance from the object's possible places in the last second
    connected: bool = False
    other_topics: int = 0  # other topics heard while there was no pose
    fault: int = PoseFault.NONE


class PoseWatch:
    """Follows poses as they come, and sums them up once a second."""

    def __init__(
        self, centre_m: tuple[float, float], half_width_m: float, scan_period_s: float
    ) -> None:
        self.figures = PoseFigures()
        self._centre_m = centre_m
        self._far_m = max(FAR_M, FAR_WIDTHS * half_width_m)
        self._scans_hz = 1.0 / scan_period_s
        self._came_s = math.nan
        self._t = math.nan  # time of the last pose
        self._nearest_s = self._nearest_m = math.inf  # least offset and reach since a look
        self._malformed = 0
        self._found = PoseFault.NONE  # fault at the last look
        self._looks: deque[tuple[float, int]] = deque(maxlen=LOOKS)

    def add(self, t: float, x: float, y: float, now: float) -> None:
        """A pose of Unix time t has come `now`."""
        self.figures.received += 1
        self._t, self._came_s = t, now
        if abs(now - t) < abs(self._nearest_s):
            self._nearest_s = now - t
        self._nearest_m = min(
            self._nearest_m, math.hypot(x - self._centre_m[0], y - self._centre_m[1])
        )

    def clock_stepped(self) -> None:
        """Forget the measurements: they are of another clock."""
        self._looks.clear()
        self._nearest_s = math.inf
        self._came_s = math.nan

    def look(
        self, now: float, malformed: int, *, connected: bool, refused: bool, topics: int
    ) -> PoseFigures:
        """The figures at the Unix time `now`; the other arguments are from the socket."""
        figures = self.figures
        figures.connected, figures.other_topics = connected, topics
        figures.age_s = NEVER_S if math.isnan(self._came_s) else max(now - self._came_s, 0.0)
        self._looks.append((now, figures.received))
        then, before = self._looks[0]
        figures.rate_hz = (figures.received - before) / (now - then) if now > then else 0.0
        if math.isfinite(self._nearest_s):
            figures.offset_s, figures.reach_m = self._nearest_s, self._nearest_m
        is_other = malformed > self._malformed or (malformed > 0 and not figures.received)
        found = self._judge(now, is_malformed=is_other, is_refused=refused)
        if found is self._found:  # seen twice in a row: a robot may start after the daemon
            figures.fault = found
        self._found = found
        self._malformed = malformed
        self._nearest_s = self._nearest_m = math.inf
        return figures

    def _judge(self, now: float, *, is_malformed: bool, is_refused: bool) -> PoseFault:
        figures = self.figures
        if figures.age_s == NEVER_S or figures.age_s > STOPPED_S:
            if is_refused:
                return PoseFault.REFUSED
            if is_malformed:
                return PoseFault.MALFORMED
            if figures.received and figures.connected:
                return PoseFault.STOPPED
            if not figures.connected:
                return PoseFault.UNCONNECTED
            return PoseFault.OTHER_TOPIC if figures.other_topics else PoseFault.UNHEARD
        if unit_of(now - figures.offset_s, now):
            return PoseFault.UNIT
        if abs(now - figures.offset_s) < UPTIME_S:
            return PoseFault.UPTIME
        if abs(figures.offset_s) > OFFSET_S:
            return PoseFault.CLOCK
        if figures.reach_m > self._far_m:
            return PoseFault.FAR
        is_long = len(self._looks) == LOOKS
        if is_long and figures.rate_hz < SLOW * self._scans_hz:
            return PoseFault.SLOW
        return PoseFault.NONE


def unit_of(t: float, now: float) -> str:
    """The unit in which a time t would be now; empty for seconds and unknown units."""
    for factor, name in UNITS.items():
        if factor * now / SPREAD < t < factor * now * SPREAD:
            return name
    return ""


def line(
    inputs: Mapping[str, Any], t: float, endpoint: str, topics: Iterable[str] = (),
    scans_hz: float = 0.0,
) -> str:  # fmt: skip
    """The fault in `health.inputs` of Unix time t in words, with its cure; empty without a fault.
    `topics`: other topics heard, where known."""
    offset_s, at = inputs["poses_offset_s"], endpoint or "the endpoint"
    try:
        fault = PoseFault(inputs["poses_fault"])
    except ValueError:
        return "at fault (by a newer daemon)"
    behind = f"{abs(offset_s):.3g} s {'behind' if offset_s > 0.0 else 'ahead of'} this machine's"
    others = ", ".join(topics) or "another topic"
    return {
        PoseFault.NONE: "",
        PoseFault.UNCONNECTED: f"nobody serves {at}: start the publisher; it binds the endpoint, "
        "the daemon connects",
        PoseFault.REFUSED: f"{at} takes the connection and refuses the daemon: robot.key must be "
        "the robot's, the robot must let in server.key, and both must use keys, or neither",
        PoseFault.OTHER_TOPIC: f"connected to {at}, and only {others} comes: publish "
        "/robot/sensor_pose",
        PoseFault.UNHEARD: f"connected to {at}, and nothing comes: publish /robot/sensor_pose",
        PoseFault.MALFORMED: "messages come and are no poses: topic, then one msgpack map "
        "{t, x, y, theta} of numbers, then the time as text",
        PoseFault.UPTIME: "t counts from the robot's start (a monotonic clock): send Unix time, "
        "time.time()",
        PoseFault.UNIT: f"t is in {unit_of(t - offset_s, t) or 'another unit'}: send seconds",
        PoseFault.CLOCK: f"the robot's clock is {behind}: let chrony or PTP keep both, and send "
        "the time of the measurement",
        PoseFault.FAR: f"the sensor is {inputs['poses_reach_m']:.3g} m from where the object may "
        "be (filter.centre_m): are x and y in millimetres? send metres",
        PoseFault.SLOW: f"{inputs['poses_rate_hz']:.3g} poses/s are fewer than the "
        f"{f'{scans_hz:.3g} ' if scans_hz else ''}scans/s: publish 100 a second",
        PoseFault.STOPPED: f"none for {inputs['poses_age_s']:.0f} s: the publisher at {at} has "
        "stopped",
    }[fault]
