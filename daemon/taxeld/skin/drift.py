"""The baseline follows drift, and never a touch.

The scans of about a second form a slice. A taxel is free in a slice when neither it nor a taxel
near it was touched then or shortly before. The baselines of free taxels follow the slice's mean, at
a bounded rate. Drift that a module's temperature explains is followed at all times.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Index
from taxeld.layout.layout import Layout
from taxeld.skin.channels import Wiring
from taxeld.skin.dips import Dips
from taxeld.skin.temperature import Temperature

DRIFT_S = 60.0  # time constant at which the baselines of free taxels follow
SLICE_S = 1.0
GAP_S = 5.0  # a longer pause between two scans begins a new slice
NEAR_M = 0.025  # a press changes its neighbours' readings, also below their thresholds
HOLD_OFF_S = 3.0  # time after a release in which the foam recovers
RATE_MAX = 0.005 / 60.0  # share of full scale a second: 100 of 20 000 counts a minute


class Slice:
    """Sums of the readings of M taxels and K temperatures over the scans of about a second."""

    def __init__(self, taxels: int, modules: int) -> None:
        self.scans: NDArray[np.int64] = np.zeros(taxels, dtype=np.int64)  # (M,) valid readings
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
        """Take counts (n,) of n taxels, 0 where not valid, with `valid` and `changed` since the
        scan before, each (n,); → whether the slice is full."""
        if not self.end <= t < self.end + GAP_S:
            self.begin(t)
        self.end = t
        self.scans[taxels] += valid
        self.changed[taxels] |= changed
        self._sum[taxels] += counts
        self._squares[taxels] += counts * counts
        return t - self.start >= SLICE_S

    def add_t0(self, modules: Index, counts: Floats, valid: Bools | int) -> None:
        """Take temperatures (n,) of n modules [counts], 0 where not `valid` (n,)."""
        self._t0_sum[modules] += counts
        self._t0_n[modules] += valid

    @property
    def mean(self) -> Floats:
        """(M,) mean [counts]; 0 without a scan."""
        return np.asarray(self._sum / np.maximum(self.scans, 1))

    @property
    def variance(self) -> Floats:
        """(M,) variance [counts²] within the slice; 0 of a single scan."""
        n = self.scans
        spread = self._squares - n * self.mean**2
        return np.maximum(spread, 0.0) / np.maximum(n - 1, 1)

    @property
    def t0(self) -> Floats:
        """(K,) mean temperature [counts]; nan without a scan."""
        return np.where(self._t0_n > 0, self._t0_sum / np.maximum(self._t0_n, 1), np.nan)


class Drift:
    """The baselines of M taxels on K modules, and everything that moves them."""

    def __init__(self, layout: Layout, wiring: Wiring, full_scale: float) -> None:
        taxels = len(layout)
        self.baseline: Floats = np.zeros(taxels)
        self.temperature = Temperature(len(wiring.suis), full_scale)
        self.dips = Dips(taxels)
        self._module = wiring.module
        self._modules = len(wiring.suis)
        self._rate_max = RATE_MAX * full_scale
        self._zero = np.zeros(taxels)  # (M,) baseline from which drift is counted
        self._busy_until = np.full(taxels, -np.inf)
        x, y, z = (axis[:, None] - axis for axis in layout.position_m.T.astype(np.float32))
        self._near: Bools = x * x + y * y + z * z <= NEAR_M**2

    def take(self, taxels: Index, counts: Floats) -> None:
        """Set new baselines (n,) of taxels (n,) [counts]."""
        self.baseline[taxels] = self._zero[taxels] = counts
        self.dips.forget(taxels)
        self.temperature.forget_drift()

    def touched(self, t: float, taxels: Bools) -> None:
        """Taxels in the mask (M,) are touched at time t."""
        at = np.flatnonzero(taxels)
        if len(at):
            self._busy_until[self._near[at].any(axis=0)] = t + HOLD_OFF_S

    def busy(self, t: float) -> Bools:
        """(M,) whether a taxel is near a touch, or was so shortly before."""
        return self._busy_until > t

    def release(self) -> None:
        """End all touches."""
        self._busy_until[:] = -np.inf

    def on_slice(self, part: Slice, usable: Bools, threshold: Floats) -> Bools:
        """Take a full slice. `usable` (M,): taxels with a baseline that can be believed;
        `threshold` (M,) [counts]; → (M,) taxels at rest: free, and within their thresholds of their
        baselines."""
        usable = usable & (part.scans > 0)
        over = np.where(usable, part.mean - self.baseline, 0.0)
        press = self._by_module(np.where(over > threshold, over, 0.0))
        self.baseline += self.temperature.on_slice(part.t0, press)[self._module]
        over = np.where(usable, part.mean - self.baseline, 0.0)
        free = usable & ~self.busy(part.start)
        self._learn_temperature(part.mean, free, usable)
        seconds = part.end - part.start
        share, most = -np.expm1(-seconds / DRIFT_S), self._rate_max * seconds
        self.baseline[free] += np.clip(share * over[free], -most, most)
        self._correct(part.mean, free & (over < -threshold), usable, threshold)
        return free & (np.abs(over) <= threshold)

    def _learn_temperature(self, mean: Floats, free: Bools, usable: Bools) -> None:
        """Learn from the common drift of modules whose taxels are all free. `mean` (M,) [counts],
        `free` (M,) and `usable` (M,) are of a slice."""
        number = self._by_module(usable)
        common = self._by_module(np.where(usable, mean - self._zero, 0.0)) / np.maximum(number, 1.0)
        self.temperature.learn(common, (number > 0) & (self._by_module(free) == number))

    def _correct(self, mean: Floats, below: Bools, usable: Bools, threshold: Floats) -> None:
        """Lower baselines that are too high, and raise those of taxels that had only dipped. All
        arrays are (M,); `mean` and `threshold` are in counts."""
        wrong = self.dips.lower(self.baseline - mean, below)
        self._zero[wrong] += mean[wrong] - self.baseline[wrong]
        self.baseline[wrong] = mean[wrong]
        risen = self.dips.rise(mean - self.baseline, usable, threshold)
        self.baseline += risen
        self._zero += risen

    def _by_module(self, values: NDArray[np.generic]) -> Floats:
        """(K,) sums of values (M,) over each module's taxels."""
        return np.bincount(self._module, values, minlength=self._modules).astype(np.float64)
