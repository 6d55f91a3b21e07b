"""The sensor's pose at the time of a scan: between two poses, or extrapolated shortly after the
last one; and how well it is known, by the age of the nearest pose and the scan's own time."""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.news import moved_m
from taxeld.model import se2

KEPT = 512  # poses: five seconds at 100 Hz
AGE_S = 0.2  # a pose that is older does not place a scan
EXTRAPOLATE_S = 0.02  # of a live robot, whose next pose may be on its way
FAR_M = 10.0  # a pose whose |x| or |y| is larger is in a wrong unit
FUTURE_S = 0.1  # a pose stamped farther in the future was stamped wrongly
REACH_PERIODS = 2.0  # pose periods after the last pose for which its motion is taken to go on
BRIEF_S = 1e-3  # poses that are closer in time were stamped as they were sent, not measured
PACED = 4  # scans of a hub whose pace the next is held to: one that was lost is soon forgotten
BACK_MAX = 10  # ordered poses in a row before the last one: the robot's clock was set back


class TakenPose(NamedTuple):
    t: float
    pose: tuple[float, float, float]


class PoseTrack:
    """The last poses (t, x, y, θ) of the sensor in the world; bounded memory."""

    def __init__(
        self,
        mount: Poses | None = None,
        extrapolate_s: float = 0.0,
        reach_m: float = 0.0,
    ) -> None:
        """`mount` (3,): the sensor's frame in the frame of the poses. `extrapolate_s`: longest time
        after the last pose for which the motion of the last two is taken to go on. `reach_m`: of
        the skin from the sensor's axis."""
        self.extrapolate_s = extrapolate_s
        self.taken = 0
        self.rejected = 0  # not finite, not later than the one before, far, or in the future
        self._mount = mount
        self._lever_m = reach_m + (0.0 if mount is None else math.hypot(*mount[:2]))
        self._back, self._back_t = 0, math.inf  # poses in a row that went back, and the last time
        self._kept: deque[TakenPose] = deque(maxlen=KEPT)

    @property
    def latest_t(self) -> float:
        return self._kept[-1].t if self._kept else -math.inf

    def reaches(self, t: float) -> bool:
        """Whether the pose at time t is known well enough that no later one is needed."""
        return self.latest_t >= t or self._goes_on(t)

    def add(self, t: float, x: float, y: float, theta: float, now: float = math.inf) -> None:
        """Take a pose that has arrived at `now`; times must increase, unless a clock was set
        back."""
        # one from the future would keep out all poses before its time; a sum is finite if each is
        is_fit = math.isfinite(t + x + y + theta) and t <= now + FUTURE_S
        is_near = max(abs(x), abs(y)) <= FAR_M
        if not (is_fit and is_near) or not (t > self.latest_t or self._is_set_back(t)):
            self.rejected += 1
            return
        self._back = 0
        self.taken += 1
        self._kept.append(TakenPose(t, (x, y, theta)))

    def clear(self) -> None:
        """Forget all poses: their times are of another clock."""
        self._kept.clear()

    def _speed_to(self, i: int) -> float:
        """Speed of the skin [m/s] from the pose before number i; 0 without one, or with a wrong
        one."""
        if not i:
            return 0.0
        (before_t, before), (t, pose) = self._kept[i - 1], self._kept[i]
        if math.dist(before[:2], pose[:2]) > se2.JUMP_M:
            return 0.0
        return moved_m(before, pose, self._lever_m) / max(t - before_t, BRIEF_S)

    def _is_set_back(self, t: float) -> bool:
        """Whether enough poses from the past came in a row that they are the present."""
        self._back = self._back + 1 if t > self._back_t else 1
        self._back_t = t
        if self._back < BACK_MAX:
            return False
        self.clear()
        return True

    def at(self, t: float) -> Poses | None:
        """The sensor's pose (3,) at time t: interpolated, extrapolated at the speed of the last
        two, or the last one while it is young enough; None where no pose is near enough in time."""
        i = self._after(t)
        if i and self._is_between(i):
            came = self._between(i - 1, t)
        elif i == len(self._kept) and self._goes_on(t):
            came = self._between(i - 2, t)
        elif i and t - self._kept[i - 1].t <= AGE_S:
            came = np.array(self._kept[i - 1].pose)
        else:
            return None
        return came if self._mount is None else se2.compose(came, self._mount)

    def sd_m(self, t: float, late_s: float) -> float:
        """Standard deviation of the skin's place at a time t of which `at` has a pose, beside the
        robot's own: its greatest speed about then, times the time to the nearest pose and the
        error of t, which is too late by anything up to `late_s`."""
        i = self._after(t)
        if not i:
            return 0.0
        newest = i if self._is_between(i) else i - 1
        age_s = min(abs(t - self._kept[k].t) for k in (i - 1, newest))
        first = max(min(self._after(t - late_s), newest) - 1, 0)
        speed = max(map(self._speed_to, range(first, newest + 1)))
        return speed * math.hypot(age_s, late_s / math.sqrt(3.0))

    def _after(self, t: float) -> int:
        """The number of the first pose after time t, which is one of the last."""
        i = len(self._kept)
        while i and self._kept[i - 1].t > t:
            i -= 1
        return i

    def _is_between(self, i: int) -> bool:
        """Whether pose number i and the one before tell of the time between them."""
        return i < len(self._kept) and self._kept[i].t - self._kept[i - 1].t <= AGE_S

    def _goes_on(self, t: float) -> bool:
        """Whether the last two poses tell the pose at the later time t."""
        if len(self._kept) < 2:
            return False
        ahead_s, period_s = t - self.latest_t, self.latest_t - self._kept[-2].t
        return 0.0 < ahead_s <= min(self.extrapolate_s, REACH_PERIODS * period_s, AGE_S)

    def _between(self, i: int, t: float) -> Poses:
        """The pose (3,) on the line through two poses, or beyond the second."""
        (t0, before), (t1, after) = self._kept[i], self._kept[i + 1]
        share = (t - t0) / (t1 - t0)
        x, y, turn = (b - a for a, b in zip(before, after, strict=True))
        if math.hypot(x, y) > se2.JUMP_M:  # one of the two is wrong, and so is everything between
            return np.array(before if share < 0.5 else after)
        theta = wrapped(before[2] + share * wrapped(turn))
        return np.array([before[0] + share * x, before[1] + share * y, theta])


def wrapped(angle: float) -> float:
    """As `se2.wrap` does it, to the same bits, and faster."""
    return angle - se2.TURN * float(np.floor((angle + np.pi) / se2.TURN))


class StandingStill(PoseTrack):
    """A sensor without a robot: always at the origin."""

    def add(self, *_: float) -> None:
        """Ignored: there is no robot."""

    def reaches(self, t: float) -> bool:  # noqa: ARG002
        return True

    def at(self, t: float) -> Poses:  # noqa: ARG002
        return se2.IDENTITY


class Pace:
    """How late a scan may be dated on a line without time stamps, whose bytes are dated as they are
    read. A hub keeps its pace, so a scan that comes behind the pace of the last ones was read so
    much later, or one before it was lost: it is taken to be a period late at most."""

    def __init__(self, period_s: float) -> None:
        """`period_s`: of the scans; inf where they have stamps."""
        self._period_s = period_s
        self._last: dict[int, deque[float]] = {}  # hub → times of its last scans

    def late_s(self, ihb: int, t: float) -> float:
        """How much later than it was sent the next scan of a hub may be dated, at t."""
        last = self._last.setdefault(ihb, deque(maxlen=PACED))
        behind = [t - before - k * self._period_s for k, before in enumerate(last, 1)]
        last.appendleft(t)
        return min(max([0.0, *behind]), self._period_s)
