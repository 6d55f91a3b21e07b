"""Whether the inputs are fresh, and the status of an estimate where they are not.

The estimator judges its belief; this module judges the inputs. Status is decided nowhere else.
"""

import math
from dataclasses import replace

from taxeld.arrays import Poses
from taxeld.estimator.estimate import Estimate, Status

USABLE = (Status.SEARCHING, Status.AMBIGUOUS, Status.CONVERGED)


class Freshness:
    """Use of the last scan, and its age."""

    def __init__(
        self,
        stale_s: float,
        centre_m: tuple[float, float] = (0.0, 0.0),
        within_m: float = math.inf,
    ) -> None:
        """`stale_s`: age of the last scan [s] beyond which the inputs are stale. An object farther
        than `within_m` from `centre_m` along x or y is outside its possible places."""
        self._centre_m = centre_m
        self._within_m = within_m
        self._stale_s = stale_s
        self._verdict: Status | None = Status.STARTING  # None: the last scan was used
        self._came_s = 0.0
        self.is_whole = True  # the hubs have the modules that the layout has

    def starting(self) -> None:
        """The idle baseline is being learned."""
        self._verdict = Status.STARTING

    def unused(self) -> None:
        """A scan came at a wrong time, or without a sensor pose."""
        self._verdict = Status.STALE

    def used(self) -> None:
        """The estimator has taken a scan."""
        self._verdict = None

    def came(self, now_s: float) -> None:
        """A scan has come, used or not, at the monotonic time `now_s`."""
        self._came_s = now_s

    def is_silent(self, now_s: float) -> bool:
        """Whether no scan has come for too long."""
        return now_s - self._came_s > self._stale_s

    def judged(self, estimate: Estimate, now_s: float | None = None) -> Estimate:
        """The estimate with the status that its inputs allow; with `now_s`, also by their age."""
        verdict = self._verdict
        if now_s is not None and self.is_silent(now_s):
            verdict = Status.STALE
        return estimate if verdict is None else replace(estimate, status=verdict)

    def is_valid(self, estimate: Estimate) -> bool:
        """Whether a subscriber may use the estimate: its inputs are fresh and whole, something was
        touched, and the object is at a possible place."""
        if not self.is_whole or estimate.contacts == 0 or estimate.status not in USABLE:
            return False
        return self._is_inside(estimate.map) and self._is_inside(estimate.mean)

    def _is_inside(self, pose: Poses) -> bool:
        x, y = self._centre_m
        return bool(max(abs(pose[0] - x), abs(pose[1] - y)) <= self._within_m)
