"""The baseline follows what the taxels read out of contact, and never what they read in one.

About once a second the mean of the scans since is looked at. A taxel is free when neither it nor
one near it was felt in that time or shortly before; only free taxels are followed, at a bounded
rate. What a module's temperature explains is taken off at all times.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.idle import Bools, Floats, Index
from taxeld.layout import Layout
from taxeld.temperature import Temperature
from taxeld.wiring import Wiring

SLICE_S = 1.0
GAP_S = 5.0  # a slice with such a pause in it is no slice
NEAR_M = 0.025  # a press moves its neighbours, though they may not feel it
HOLD_OFF_S = 3.0  # after a release the skin recovers
RATE_MAX = 0.005 / 60.0  # of full scale a second: 100 of 20 000 counts a minute
BELOW_SLICES = 2  # as pressure cannot be negative, so long below its threshold is a wrong baseline
BACK_SLICES = 3  # and so long back where all that were lowered together had been, it was right
BACK_SHARE = 0.25  # of the threshold: no press brings every taxel so near to that


class Slice:
    """What M taxels and K temperatures read in the scans of about a second."""

    def __init__(self, taxels: int, modules: int) -> None:
        self.scans: NDArray[np.int64] = np.zeros(taxels, dtype=np.int64)  # valid readings
        self.changed: Bools = np.zeros(taxels, dtype=bool)
        self._sum = np.zeros(taxels)
        self._squares = np.zeros(taxels)
        self._t0_sum = np.zeros(modules)
        self._t0_n = np.zeros(modules, dtype=np.int64)
        self.begin(-np.inf)

    def begin(self, t: float) -> None:
        self.start = self.end = t
        for total in (self.scans, self.changed, self._sum, self._squares, self._t0_sum, self._t0_n):
            total[:] = 0

    def clock_stepped(self, by: float) -> None:
        self.start += by
        self.end += by

    def add(self, t: float, taxels: Index, counts: Floats, valid: Bools, changed: Bools) -> bool:
        """Counts of some taxels, 0 where not valid, and whether they have changed since the scan
        before; → whether the slice is full."""
        if not self.end <= t < self.end + GAP_S:
            self.begin(t)
        self.end = t
        self.scans[taxels] += valid
        self.changed[taxels] |= changed
        self._sum[taxels] += counts
        self._squares[taxels] += counts * counts
        return t - self.start >= SLICE_S

    def add_t0(self, modules: Index, counts: Floats, valid: Bools) -> None:
        self._t0_sum[modules] += np.where(valid, counts, 0.0)
        self._t0_n[modules] += valid

    @property
    def mean(self) -> Floats:
        """(M,) counts; 0 without a scan."""
        return np.asarray(self._sum / np.maximum(self.scans, 1))

    @property
    def variance(self) -> Floats:
        """(M,) counts², about the slice's own mean; 0 of a single scan."""
        n = self.scans
        spread = self._squares - n * self.mean**2
        return np.maximum(spread, 0.0) / np.maximum(n - 1, 1)

    @property
    def t0(self) -> Floats:
        """(K,) counts; nan without a scan."""
        return np.where(self._t0_n > 0, self._t0_sum / np.maximum(self._t0_n, 1), np.nan)


class Drift:
    """The baseline of M taxels, and what moves it."""

    def __init__(self, layout: Layout, wiring: Wiring, full_scale: float, drift_s: float) -> None:
        """`drift_s`: the time constant of following."""
        taxels = len(layout)
        self.baseline: Floats = np.zeros(taxels)
        self.temperature = Temperature(len(wiring.suis), full_scale)
        self.lowered = 0  # taxels whose baseline was found too high
        self.raised = 0  # of them, those that had only dipped
        self._module = wiring.module
        self._members = np.bincount(wiring.module)
        self._drift_s = drift_s
        self._rate_max = RATE_MAX * full_scale
        self._zero = np.zeros(taxels)  # the baseline that drift is counted from
        self._busy_until = np.full(taxels, -np.inf)
        self._below = np.zeros(taxels, dtype=np.int64)
        self._lowered_by = np.zeros(taxels)
        self._dip = np.zeros(taxels, dtype=np.int64)  # which were lowered together
        self._back: dict[int, int] = {}  # of those, for how many slices they have been back
        x, y, z = (axis[:, None] - axis for axis in layout.position_m.T.astype(np.float32))
        self._near: Bools = x * x + y * y + z * z <= NEAR_M**2

    @property
    def followed(self) -> Floats:
        """By how much the baseline has moved since it was taken (M,) [counts]."""
        return self.baseline - self._zero

    def take(self, taxels: Index, counts: Floats) -> None:
        """New baselines of some taxels."""
        self.baseline[taxels] = self._zero[taxels] = counts
        self._below[taxels] = 0
        self._lowered_by[taxels] = 0.0
        self.temperature.forget_drift()

    def touched(self, t: float, felt: Bools) -> None:
        """Which taxels feel something at time t."""
        at = np.flatnonzero(felt)
        if len(at):
            self._busy_until[self._near[at].any(axis=0)] = t + HOLD_OFF_S

    def busy(self, t: float) -> Bools:
        """Taxels (M,) that are near a touch, or were so lately."""
        return self._busy_until > t

    def release(self) -> None:
        """Nothing is touched, whatever was felt."""
        self._busy_until[:] = -np.inf

    def clock_stepped(self, by: float) -> None:
        self._busy_until += by

    def on_slice(self, part: Slice, usable: Bools, threshold: Floats) -> Bools:
        """A full slice; `usable` taxels (M,) have a baseline and can be believed; → which of them
        were at rest: free of any touch, and at their baselines."""
        usable = usable & (part.scans > 0)
        over = np.where(usable, part.mean - self.baseline, 0.0)
        press = self._by_module(np.where(over > threshold, over, 0.0))
        self.baseline += self.temperature.on_slice(part.t0, press)[self._module]
        over = np.where(usable, part.mean - self.baseline, 0.0)
        free = usable & ~self.busy(part.start)
        self._learn(part.mean, free, usable)
        seconds = part.end - part.start
        share, most = -np.expm1(-seconds / self._drift_s), self._rate_max * seconds
        self.baseline[free] += np.clip(share * over[free], -most, most)
        self._lower(part.mean, free & (over < -threshold))
        if self._lowered_by.any():
            self._raise(part.mean, usable, BACK_SHARE * threshold)
        return free & (np.abs(over) <= threshold)

    def _learn(self, mean: Floats, free: Bools, usable: Bools) -> None:
        """Tell the temperature what the taxels of wholly free modules have in common."""
        number = self._by_module(usable)
        common = self._by_module(np.where(usable, mean - self._zero, 0.0)) / np.maximum(number, 1.0)
        self.temperature.learn(common, (number > 0) & (self._by_module(free) == number))

    def _lower(self, mean: Floats, below: Bools) -> None:
        self._below = np.where(below, self._below + 1, 0)
        wrong = self._below >= BELOW_SLICES
        if wrong.any():
            self._zero[wrong] += mean[wrong] - self.baseline[wrong]
            self._lowered_by[wrong] += self.baseline[wrong] - mean[wrong]
            self._dip[wrong] = self.lowered + 1  # a number that no other has
            self.baseline[wrong] = mean[wrong]
            self._below[wrong] = 0
            self.lowered += int(wrong.sum())

    def _raise(self, mean: Floats, usable: Bools, near: Floats) -> None:
        """A skin that read too low for a while would feel a touch for ever: its baselines come back
        with its readings."""
        lowered = self._lowered_by > 0.0
        away = np.abs(mean - self.baseline - self._lowered_by) > near
        for dip in np.unique(self._dip[lowered]).tolist():
            those = lowered & (self._dip == dip)
            is_back = usable[those].all() and not away[those].any()
            self._back[dip] = self._back.get(dip, 0) + 1 if is_back else 0
            if self._back[dip] >= BACK_SLICES:
                self.baseline[those] += self._lowered_by[those]
                self._zero[those] += self._lowered_by[those]
                self._lowered_by[those] = 0.0
                self.raised += int(those.sum())
                del self._back[dip]

    def _by_module(self, values: NDArray[np.generic]) -> Floats:
        """Sums over each module's taxels (K,)."""
        return np.bincount(self._module, values, minlength=len(self._members)).astype(np.float64)
