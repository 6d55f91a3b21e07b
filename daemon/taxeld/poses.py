"""The sensor's pose over time, interpolated to the moment of a scan."""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable

import numpy as np

from taxeld import se2
from taxeld.se2 import Poses

KEPT = 512  # poses: five seconds at 100 Hz
JUMP_M = 1.0  # a sensor that moved farther between two poses, or two scans, did not
BACK_MAX = 10  # poses in a row from before the last, in order: the robot's clock was set back


class PoseTrack:
    """The last poses (t, x, y, θ) of the sensor in the world; bounded memory."""

    def __init__(
        self,
        max_age_s: float,
        on_pose: Callable[[float, float, float, float], None] | None = None,
    ) -> None:
        """`on_pose` hears every pose (t, x, y, θ) that is taken."""
        self.max_age_s = max_age_s
        self._on_pose = on_pose
        self.taken = 0
        self.rejected = 0  # not finite, or not later than the one before
        self.begun_again = 0  # times that the robot's clock was seen to be set back
        self._back, self._back_t = 0, np.inf  # poses in a row that went back, and the last of them
        self._t: deque[float] = deque(maxlen=KEPT)
        self._pose: deque[tuple[float, float, float]] = deque(maxlen=KEPT)

    @property
    def latest_t(self) -> float:
        return self._t[-1] if self._t else -np.inf

    def add(self, t: float, x: float, y: float, theta: float) -> None:
        """Take a pose; times must increase, but for a clock that was set back."""
        if not all(map(math.isfinite, (t, x, y, theta))):
            self.rejected += 1
            return
        if t <= self.latest_t and not self._is_set_back(t):
            self.rejected += 1
            return
        self._back = 0
        self.taken += 1
        self._t.append(t)
        self._pose.append((x, y, theta))
        if self._on_pose is not None:
            self._on_pose(t, float(x), float(y), float(theta))

    def clear(self) -> None:
        """Forget all poses: their times are of another clock."""
        self._t.clear()
        self._pose.clear()

    def _is_set_back(self, t: float) -> bool:
        """Whether this pose from the past is the last of so many that they are the present."""
        self._back = self._back + 1 if t > self._back_t else 1
        self._back_t = t
        if self._back < BACK_MAX:
            return False
        self.begun_again += 1
        self.clear()
        return True

    def at(self, t: float) -> Poses | None:
        """The pose (3,) at time t: interpolated, or the last one while it is young enough; None
        where nothing that near in time is known."""
        i = bisect_right(self._t, t)
        if i == 0:
            return None
        before: Poses = np.array(self._pose[i - 1])
        t_before = self._t[i - 1]
        if i == len(self._t):
            return before if t - t_before <= self.max_age_s else None
        after: Poses = np.array(self._pose[i])
        span = self._t[i] - t_before
        if span > self.max_age_s:
            return before if t - t_before <= self.max_age_s else None
        share = (t - t_before) / span
        if np.hypot(*(after - before)[:2]) > JUMP_M:  # one of them is wrong, as is all between
            return before if share < 0.5 else after
        pose: Poses = before + share * (after - before)
        pose[2] = se2.wrap(before[2] + share * se2.wrap(after[2] - before[2]))
        return pose


class StandingStill:
    """A sensor without a robot: always at the origin."""

    max_age_s = np.inf
    taken = rejected = begun_again = 0
    latest_t = np.inf

    def clear(self) -> None:
        """There is nothing to forget."""

    def at(self, t: float) -> Poses:  # noqa: ARG002
        return se2.IDENTITY
