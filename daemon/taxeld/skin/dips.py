"""Taxels that read below their baseline: a baseline that is too high, or a dip of the readings.

Pressure is never negative, so a baseline that stays above the readings is lowered to them. Readings
that had only dipped return, and would then look like a touch for ever. So once all taxels that were
lowered together read what they did before, their baselines return too.
"""

import numpy as np

from taxeld.arrays import Bools, Floats, Index

BELOW_SLICES = 2  # in a row below the threshold: the baseline is too high
BACK_SLICES = 3  # in a row with all taxels back: the readings had only dipped
BACK_SHARE = 0.25  # of the threshold: so near to the old reading is back; no press brings all there


class Dips:
    """The lowered baselines of M taxels."""

    def __init__(self, taxels: int) -> None:
        self.lowered = 0  # taxels, since start
        self.raised = 0  # of them: those that had only dipped
        self._below = np.zeros(taxels, dtype=np.int64)  # slices in a row
        self._by = np.zeros(taxels)  # by how much each was lowered [counts]
        self._group = np.zeros(taxels, dtype=np.int64)  # which were lowered together
        self._back: dict[int, int] = {}  # slices in a row with a whole group back

    def forget(self, taxels: Index) -> None:
        """These taxels have a new baseline."""
        self._below[taxels] = 0
        self._by[taxels] = 0.0

    def lower(self, gap: Floats, below: Bools) -> Bools:
        """How far the baselines (M,) are above the slice's mean [counts], and which of them by more
        than the threshold; → those to be lowered to the mean."""
        self._below = np.where(below, self._below + 1, 0)
        wrong: Bools = self._below >= BELOW_SLICES
        if wrong.any():
            self._by[wrong] += gap[wrong]
            self._group[wrong] = self.lowered + 1  # a number that no other group has
            self._below[wrong] = 0
            self.lowered += int(wrong.sum())
        return wrong

    def rise(self, over: Floats, usable: Bools, threshold: Floats) -> Floats:
        """The slice's mean over the baselines (M,) [counts]; → by how much to raise these."""
        risen = np.zeros_like(self._by)
        lowered = self._by > 0.0
        if not lowered.any():
            return risen
        away = np.abs(over - self._by) > BACK_SHARE * threshold
        for group in np.unique(self._group[lowered]).tolist():
            those = lowered & (self._group == group)
            is_back = usable[those].all() and not away[those].any()
            self._back[group] = self._back.get(group, 0) + 1 if is_back else 0
            if self._back[group] >= BACK_SLICES:
                risen[those] = self._by[those]
                self._by[those] = 0.0
                self.raised += int(those.sum())
                del self._back[group]
        return risen
