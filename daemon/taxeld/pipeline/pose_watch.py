"""How the robot's poses come: their rate, their age and their clock, and the fault that this shows.

docs/troubleshooting.md has more mistakes, by the counts of `taxeld status`.
"""

import math
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass

from taxeld.pipeline.poses import FAR_M

LOOKS = 5  # looks, a second each, over which rate and clock are judged
SEEN = 3  # looks in a row that must show a fault: a busy machine is late now and then
OFFSET_S = 0.05  # s between the robot's clock and this one
SLOW = 0.9  # share of the scans' rate: fewer poses are too few
STOPPED_S = 1.0  # s without a pose after which they have stopped
NEVER_S = -1.0  # age reported before the first pose


@dataclass(slots=True)
class PoseFigures:
    """Figures of the last looks; part of health."""

    rate_hz: float = 0.0
    age_s: float = NEVER_S  # time since the last pose
    offset_s: float = 0.0  # least delay of the poses' times behind this clock in the last looks
    connected: bool = False


class PoseWatch:
    """Follows poses as they come, and sums them up once a second."""

    def __init__(self, endpoint: str, scan_period_s: float) -> None:
        self.figures = PoseFigures()
        self.fault = ""  # the fault with its cure, once it was seen SEEN times
        self._endpoint, self._scans_hz = endpoint, 1.0 / scan_period_s
        self._received = self._malformed = 0
        self._is_far = False  # a pose since the last look was
        self._came_s = math.nan
        self._nearest_s = math.inf  # least offset since a look
        self._found, self._times = "", 0  # fault at the last look, and how often it was seen
        self._looks: deque[tuple[float, int, float]] = deque(maxlen=LOOKS)

    def add(self, t: float, now: float, *, is_far: bool = False) -> None:
        """A pose of Unix time t has come `now`, used or not; `is_far`: too far from the origin."""
        self._is_far |= is_far
        self._received += 1
        self._came_s = now
        self._nearest_s = min(self._nearest_s, now - t, key=abs)

    def clock_stepped(self) -> None:
        """Forget the measurements: they are of another clock."""
        self._looks.clear()
        self._nearest_s, self._came_s = math.inf, math.nan

    def look(
        self,
        now: float,
        malformed: int,
        reason: str,
        topics: Collection[str],
        *,
        connected: bool,
        refused: bool,
        is_heard: bool = True,
    ) -> PoseFigures:
        """The figures at the Unix time `now`; the other arguments are from the socket: messages
        that are no poses, and the `reason` of the last, other topics that are heard, and the state
        of the connection. Without `is_heard` the door hangs, and no fault is the robot's."""
        figures = self.figures
        figures.connected = connected
        figures.age_s = NEVER_S if math.isnan(self._came_s) else max(now - self._came_s, 0.0)
        self._looks.append((now, self._received, self._nearest_s))
        then, before, _ = self._looks[0]
        figures.rate_hz = (self._received - before) / (now - then) if now > then else 0.0
        offsets = [offset for *_, offset in self._looks if math.isfinite(offset)]
        figures.offset_s = min(offsets, key=abs, default=figures.offset_s)
        if malformed > self._malformed:
            found = f"messages come and are no poses: {reason}"
        else:
            found = self._judge(topics, is_refused=refused)
        found = found if is_heard else ""
        self._times = self._times + 1 if found == self._found else 1
        if self._times >= SEEN or not found:
            self.fault = found
        self._found, self._malformed, self._nearest_s = found, malformed, math.inf
        self._is_far = False
        return figures

    def _judge(self, topics: Collection[str], *, is_refused: bool) -> str:
        figures, at = self.figures, self._endpoint
        if not 0.0 <= figures.age_s <= STOPPED_S:
            if is_refused:
                return f"{at} refuses the daemon: both must use keys, or neither (curve.directory)"
            if not figures.connected:
                return f"nobody serves {at}: start the publisher; it binds, the daemon connects"
            heard = f"only {', '.join(topics)} comes" if topics else "no pose comes"
            return f"connected to {at}, and {heard}: publish /robot/sensor_pose"
        if len(self._looks) == LOOKS and abs(figures.offset_s) > OFFSET_S:
            return (
                "their times are not of this machine's clock: send Unix time in seconds, and let "
                "chrony or PTP keep both clocks"
            )
        if self._is_far:
            return f"x or y is beyond {FAR_M:g} m: send metres, not millimetres"
        if len(self._looks) == LOOKS and figures.rate_hz < SLOW * self._scans_hz:
            return "fewer poses than scans come: publish 100 a second"
        return ""
