"""The baseline follows drift, and never a touch.

The scans of about a second form a slice. A taxel is free in a slice when neither it nor a taxel
near it was touched then or shortly before. The baselines of free taxels follow the slice's mean, at
a bounded rate. Drift that a module's temperature explains is followed at all times.

Pressure is never negative, so a baseline that stays above the readings is lowered to them. Readings
that had only dipped return, and would then look like a touch for ever. So once all taxels that were
lowered together read what they did before, their baselines return too.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Index
from taxeld.layout.layout import BLOCK, Layout
from taxeld.skin.channels import Wiring

DRIFT_S = 60.0  # time constant at which the baselines of free taxels follow
SLICE_S = 1.0
GAP_S = 5.0  # a longer pause between two scans begins a new slice
NEAR_M = 0.025  # a press changes its neighbours' readings, also below their thresholds
HOLD_OFF_S = 3.0  # time after a release in which the foam recovers
RATE_MAX = 0.005 / 60.0  # share of full scale a second: 100 of 20 000 counts a minute
BELOW_SLICES = 2  # slices in a row below the threshold that show a baseline too high
BACK_SLICES = 3  # slices in a row with all taxels back that show a mere dip
# share of the threshold: a reading this near to the old one is back; no press brings all there
BACK_SHARE = 0.25

MEMORY = 1800.0  # slices of a second after which a slice weighs 1/e in the temperature's share
MOVES = 0.002  # share of full scale: with a smaller sd of T0 the coefficient is not learned
EXPLAINS = 0.5  # share of the common drift's variance: with less the coefficient is 0
COEFFICIENT_MAX = 5.0  # counts of drift a count of T0
LEAK_MAX = 0.5  # counts of T0 a count of a module's summed press
PRESS = 0.02  # share of full scale: with smaller jumps of the summed press the leak is not learned
T0_STEP = 0.005  # share of full scale: a larger change in one slice is a new zero of the channel


class Slice:
    """Sums over the scans of about a second, of n channels: taxels, then temperatures."""

    def __init__(self, channels: int) -> None:
        self.scans: NDArray[np.int64] = np.zeros(channels, dtype=np.int64)  # (n,) valid readings
        self.changed: Bools = np.zeros(channels, dtype=bool)  # (n,) whether any reading differs
        self._sum, self._squares = np.zeros((2, channels))
        self.begin(-np.inf)

    def begin(self, t: float) -> None:
        self.start = self.end = t
        for total in (self.scans, self.changed, self._sum, self._squares):
            total[:] = 0

    def add(self, t: float, places: Index | slice, counts: Floats, changed: Bools) -> bool:
        """Take counts (k,) of k channels, 0 where not valid, and whether they have changed since
        the scan before (k,); → whether the slice is full."""
        if not self.end <= t < self.end + GAP_S:
            self.begin(t)
        self.end = t
        self.scans[places] += counts > 0
        self.changed[places] |= changed
        self._sum[places] += counts
        self._squares[places] += counts * counts
        return t - self.start >= SLICE_S

    @property
    def mean(self) -> Floats:
        """(n,) mean [counts]; 0 without a scan."""
        return np.asarray(self._sum / np.maximum(self.scans, 1))

    @property
    def variance(self) -> Floats:
        """(n,) variance [counts²] within the slice; 0 of a single scan."""
        spread = self._squares - self.scans * self.mean**2
        return np.maximum(spread, 0.0) / np.maximum(self.scans - 1, 1)


class Drift:
    """The baselines of M taxels on K modules, and everything that moves them."""

    def __init__(self, layout: Layout, wiring: Wiring, full_scale: float) -> None:
        taxels = len(layout)
        self.baseline: Floats = np.zeros(taxels)
        self.temperature = Temperature(len(wiring.suis), full_scale)
        self.lowered = 0  # baselines lowered, since start
        self._module = wiring.module
        self._rate_max = RATE_MAX * full_scale
        self._zero = np.zeros(taxels)  # (M,) baseline from which drift is counted
        self._below = np.zeros(taxels, dtype=np.int64)  # (M,) slices in a row below the threshold
        self._by = np.zeros(taxels)  # (M,) amount by which each was lowered [counts]
        self._group = np.zeros(taxels, dtype=np.int64)  # (M,) number of the group lowered together
        self._back = np.zeros(taxels, dtype=np.int64)  # (M,) slices in a row with its group back
        self._busy_until = np.full(taxels, -np.inf)
        self._place = layout.position_m.T.astype(np.float32)  # (3, M)

    def take(self, taxels: Index, counts: Floats) -> None:
        """Set new baselines (n,) of taxels (n,) [counts]."""
        self.baseline[taxels] = self._zero[taxels] = counts
        self._below[taxels] = self._by[taxels] = 0
        self.temperature.forget_drift()

    def touched(self, t: float, taxels: Bools) -> None:
        """Taxels in the mask (M,) are touched at time t."""
        at = np.flatnonzero(taxels)
        for some in np.split(at, range(BLOCK, len(at), BLOCK)):
            x, y, z = (axis[some, None] - axis for axis in self._place)
            near = (x * x + y * y + z * z <= NEAR_M**2).any(axis=0)
            self._busy_until[near] = t + HOLD_OFF_S

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
        taxels = len(usable)
        mean, t0 = np.split(np.where(part.scans > 0, part.mean, np.nan), [taxels])
        usable = usable & (part.scans[:taxels] > 0)
        over = np.where(usable, mean - self.baseline, 0.0)
        press = self.by_module(np.where(over > threshold, over, 0.0))
        self.baseline += self.temperature.on_slice(t0, press)[self._module]
        over = np.where(usable, mean - self.baseline, 0.0)
        free = usable & ~self.busy(part.start)
        self._learn_temperature(mean, free, usable)
        seconds = part.end - part.start
        share, most = -np.expm1(-seconds / DRIFT_S), self._rate_max * seconds
        self.baseline[free] += np.clip(share * over[free], -most, most)
        self._lower(mean, free & (over < -threshold))
        self._raise(mean, usable, threshold)
        return free & (np.abs(over) <= threshold)

    def by_module(self, values: NDArray[np.generic]) -> Floats:
        """(K,) sums of values (M,) over each module's taxels."""
        modules = len(self.temperature.coefficient)
        return np.bincount(self._module, values, modules).astype(np.float64)

    def _learn_temperature(self, mean: Floats, free: Bools, usable: Bools) -> None:
        """Learn from the common drift of modules whose taxels are all free, by a slice's `mean`
        (M,) [counts]; `free` and `usable` are (M,)."""
        number = self.by_module(usable)
        common = self.by_module(np.where(usable, mean - self._zero, 0.0)) / np.maximum(number, 1.0)
        self.temperature.learn(common, (number > 0) & (self.by_module(free) == number))

    def _lower(self, mean: Floats, below: Bools) -> None:
        """Lower baselines to the slice's `mean` (M,) [counts] where that was too low for long:
        `below` (M,) now."""
        self._below = np.where(below, self._below + 1, 0)
        wrong = self._below >= BELOW_SLICES
        gap = np.where(wrong, self.baseline - mean, 0.0)
        self._by += gap
        self._move(-gap)
        self._group[wrong] = self.lowered + 1
        self._below[wrong] = 0
        self.lowered += int(wrong.sum())

    def _raise(self, mean: Floats, usable: Bools, threshold: Floats) -> None:
        """Raise lowered baselines again where all of a group are back; each is (M,)."""
        lowered = self._by > 0.0
        away = ~usable | ~(np.abs(mean - self.baseline - self._by) <= BACK_SHARE * threshold)
        is_back = lowered & ~np.isin(self._group, self._group[lowered & away])
        self._back = np.where(is_back, self._back + 1, 0)
        risen = self._back >= BACK_SLICES
        self._move(np.where(risen, self._by, 0.0))
        self._by[risen] = self._back[risen] = 0

    def _move(self, by: Floats) -> None:
        """Correct baselines by counts (M,) that are no drift."""
        self.baseline += by
        self._zero += by


class Temperature:
    """How much of the common drift of a module's taxels its temperature T0 explains, for K modules.

    The coefficient comes from a regression, out of contact, of the module's common drift on the
    change of T0; old slices fade. T0 also reads a small share of every press, the leak. It is
    learned from slices in which both jump, and subtracted. A module without T0 is nan throughout,
    and its drift stays unexplained."""

    def __init__(self, modules: int, full_scale: float) -> None:
        self.coefficient: Floats = np.zeros(modules)
        self.leak: Floats = np.zeros(modules)
        self._moves = (MOVES * full_scale) ** 2
        self._press_min = PRESS * full_scale
        self._step_max = T0_STEP * full_scale
        self._t0 = np.full(modules, np.nan)
        self._press = np.zeros(modules)
        self._leaks = np.zeros((2, modules))  # sums of press², and of press times T0
        self._moved = np.zeros(modules)  # (K,) change of T0 since the start [counts]
        self.forget_drift()

    @property
    def level(self) -> Floats:
        """(K,) last known T0 without the leak of a press [counts]."""
        return np.asarray(self._t0 - self.leak * self._press)

    def set_leak(self, leak: Floats) -> None:
        """Use the leak (K,) of a stored state; it weighs as much as one press."""
        self.leak = leak.copy()
        self._leaks = self._press_min**2 * np.stack([np.ones_like(leak), leak])

    def forget_drift(self) -> None:
        """Give the common drift a new zero."""
        self._sums = np.zeros((6, len(self._moved)))  # of 1, x, y, x², xy, y²: T0 x, drift y

    def on_slice(self, t0: Floats, press: Floats) -> Floats:
        """Take means over a slice for each module: T0 (K,) [counts], and `press` (K,), the sum of
        its taxels' counts over their baselines; → (K,) motion of the taxels' idle readings with T0
        [counts]."""
        known = ~np.isnan(t0)
        by, pressed = t0 - self._t0, press - self._press
        told = (np.abs(pressed) > self._press_min) & ~np.isnan(by)
        self._leaks[:, told] += (pressed * np.stack([pressed, by]))[:, told]
        square, product = self._leaks
        ratio = np.clip(product / np.maximum(square, 1.0), 0.0, LEAK_MAX)
        self.leak = np.where(square > 0.0, ratio, self.leak)
        moved = np.nan_to_num(by - self.leak * pressed)
        moved[np.abs(moved) > self._step_max] = 0.0
        self._t0 = np.where(known, t0, self._t0)
        self._press = np.where(known, press, self._press)
        self._moved += moved
        return np.asarray(self.coefficient * moved)

    def learn(self, common: Floats, untouched: Bools) -> None:
        """Take the common drift (K,) of each module's taxels since its zero [counts]; only
        `untouched` (K,) modules are used."""
        used = untouched & ~np.isnan(self._t0)
        x, y = self._moved[used], common[used]
        now = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
        self._sums[:, used] = (1.0 - 1.0 / MEMORY) * self._sums[:, used] + now
        n = np.maximum(self._sums[0], 1.0)
        x, y, xx, xy, yy = self._sums[1:] / n
        xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
        slope = np.clip(xy / np.maximum(xx, 1.0 / n), -COEFFICIENT_MAX, COEFFICIENT_MAX)
        explained = np.where(xy**2 >= EXPLAINS * xx * yy, slope, 0.0)
        self.coefficient = np.where(xx > self._moves, explained, self.coefficient)
