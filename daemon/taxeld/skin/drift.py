"""The baseline follows drift, and never a touch.

The scans of about a second are a slice. A taxel is free in it when neither it nor one near it was
touched then or shortly before. The baselines of free taxels follow the slice's mean, at a bounded
rate. The drift that a module's temperature explains is followed at all times.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Index
from taxeld.layout.layout import Layout
from taxeld.skin.channels import Wiring
from taxeld.skin.dips import Dips
from taxeld.skin.temperature import Temperature

SLICE_S = 1.0
GAP_S = 5.0  # a longer pause between two scans begins a new slice
NEAR_M = 0.025  # a press changes the readings of its neighbours, also below their thresholds
HOLD_OFF_S = 3.0  # after a release, while the foam recovers
RATE_MAX = 0.005 / 60.0  # of full scale a second: 100 of 20 000 counts a minute


class Slice:
    """Sums of what M taxels and K temperatures read in the scans of about a second."""

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

    def add(
        self, t: float, taxels: Index | slice, counts: Floats, valid: Bools | int, changed: Bools
    ) -> bool:
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

    def add_t0(self, modules: Index, counts: Floats, valid: Bools | int) -> None:
        """Counts of some modules' temperatures, 0 where not valid."""
        self._t0_sum[modules] += counts
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
    """The baselines of M taxels on K modules, and what moves them."""

    def __init__(self, layout: Layout, wiring: Wiring, full_scale: float, drift_s: float) -> None:
        """`drift_s`: the time constant of following."""
        taxels = len(layout)
        self.baseline: Floats = np.zeros(taxels)
        self.temperature = Temperature(len(wiring.suis), full_scale)
        self.dips = Dips(taxels)
        self._module = wiring.module
        self._modules = len(wiring.suis)
        self._drift_s = drift_s
        self._rate_max = RATE_MAX * full_scale
        self._zero = np.zeros(taxels)  # the baseline that drift is counted from
        self._busy_until = np.full(taxels, -np.inf)
        x, y, z = (axis[:, None] - axis for axis in layout.position_m.T.astype(np.float32))
        self._near: Bools = x * x + y * y + z * z <= NEAR_M**2

    @property
    def followed(self) -> Floats:
        """By how much the baseline has moved since it was captured (M,) [counts]."""
        return self.baseline - self._zero

    def take(self, taxels: Index, counts: Floats) -> None:
        """New baselines of some taxels."""
        self.baseline[taxels] = self._zero[taxels] = counts
        self.dips.forget(taxels)
        self.temperature.forget_drift()

    def touched(self, t: float, taxels: Bools) -> None:
        """These taxels (M,) are touched at time t."""
        at = np.flatnonzero(taxels)
        if len(at):
            self._busy_until[self._near[at].any(axis=0)] = t + HOLD_OFF_S

    def busy(self, t: float) -> Bools:
        """Taxels (M,) that are near a touch, or were so lately."""
        return self._busy_until > t

    def release(self) -> None:
        """Nothing is touched, whatever was before."""
        self._busy_until[:] = -np.inf

    def on_slice(self, part: Slice, usable: Bools, threshold: Floats) -> Bools:
        """A full slice; `usable` taxels (M,) have a baseline and can be believed; → which of them
        were at rest: free, and within their thresholds of their baselines."""
        usable = usable & (part.scans > 0)
        over = np.where(usable, part.mean - self.baseline, 0.0)
        press = self._by_module(np.where(over > threshold, over, 0.0))
        self.baseline += self.temperature.on_slice(part.t0, press)[self._module]
        over = np.where(usable, part.mean - self.baseline, 0.0)
        free = usable & ~self.busy(part.start)
        self._learn_temperature(part.mean, free, usable)
        seconds = part.end - part.start
        share, most = -np.expm1(-seconds / self._drift_s), self._rate_max * seconds
        self.baseline[free] += np.clip(share * over[free], -most, most)
        self._correct(part.mean, free & (over < -threshold), usable, threshold)
        return free & (np.abs(over) <= threshold)

    def _learn_temperature(self, mean: Floats, free: Bools, usable: Bools) -> None:
        """From the common drift of the modules whose taxels are all free."""
        number = self._by_module(usable)
        common = self._by_module(np.where(usable, mean - self._zero, 0.0)) / np.maximum(number, 1.0)
        self.temperature.learn(common, (number > 0) & (self._by_module(free) == number))

    def _correct(self, mean: Floats, below: Bools, usable: Bools, threshold: Floats) -> None:
        """Lower the baselines that are too high, and raise those of taxels that had only dipped."""
        wrong = self.dips.lower(self.baseline - mean, below)
        self._zero[wrong] += mean[wrong] - self.baseline[wrong]
        self.baseline[wrong] = mean[wrong]
        risen = self.dips.rise(mean - self.baseline, usable, threshold)
        self.baseline += risen
        self._zero += risen

    def _by_module(self, values: NDArray[np.generic]) -> Floats:
        """Sums over each module's taxels (K,)."""
        return np.bincount(self._module, values, minlength=self._modules).astype(np.float64)
