"""How much of the common drift of a module's taxels its temperature T0 explains.

The coefficient comes from a regression, out of contact, of the module's common drift on the change
of T0; old slices fade. T0 also reads a small share of every press, the leak. The leak is learned
from slices in which both jump, and subtracted.
"""

import numpy as np

from taxeld.arrays import Bools, Floats

MEMORY = 1800.0  # slices of a second after which a slice weighs 1/e
MOVES = 0.002  # share of full scale: with a smaller sd of T0 the coefficient is not learned
EXPLAINS = 0.5  # share of the common drift's variance: with less the coefficient is 0
COEFFICIENT_MAX = 5.0  # counts of drift a count of T0
LEAK_MAX = 0.5  # counts of T0 a count of a module's summed press
PRESS = 0.02  # share of full scale: with smaller jumps of the summed press the leak is not learned
STEP = 0.005  # share of full scale: a larger change in one slice is a new zero of the channel


class Temperature:
    """T0 of K modules. A module without T0 is nan throughout, and its drift stays unexplained."""

    def __init__(self, modules: int, full_scale: float) -> None:
        self.coefficient: Floats = np.zeros(modules)
        self.leak: Floats = np.zeros(modules)
        self._moves = (MOVES * full_scale) ** 2
        self._press_min = PRESS * full_scale
        self._step_max = STEP * full_scale
        self._t0 = np.full(modules, np.nan)
        self._press = np.zeros(modules)
        self._leak_xx, self._leak_xy = np.zeros(modules), np.zeros(modules)
        self._moved = np.zeros(modules)  # (K,) change of T0 since the start [counts]
        self.forget_drift()

    @property
    def level(self) -> Floats:
        """(K,) last known T0 without the leak of a press [counts]."""
        return np.asarray(self._t0 - self.leak * self._press)

    def set_leak(self, leak: Floats) -> None:
        """Use the leak (K,) of a stored state; it weighs as much as one press."""
        self.leak = leak.copy()
        self._leak_xx[:] = self._press_min**2
        self._leak_xy = leak * self._leak_xx

    def forget_drift(self) -> None:
        """Give the common drift a new zero."""
        modules = len(self._moved)
        self._weight, self._x, self._y = np.zeros(modules), np.zeros(modules), np.zeros(modules)
        self._xx, self._xy, self._yy = np.zeros(modules), np.zeros(modules), np.zeros(modules)

    def on_slice(self, t0: Floats, press: Floats) -> Floats:
        """Take means over a slice for each module: T0 (K,) [counts], and `press` (K,), the sum of
        its taxels' counts over their baselines; → (K,) motion of the taxels' idle readings with T0
        [counts]."""
        known = ~np.isnan(t0)
        by, pressed = t0 - self._t0, press - self._press
        self._learn_leak(by, pressed)
        moved = np.nan_to_num(by - self.leak * pressed)
        stepped = np.abs(moved) > self._step_max
        moved[stepped] = 0.0
        self._t0 = np.where(known, t0, self._t0)
        self._press = np.where(known, press, self._press)
        self._moved += moved
        return np.asarray(self.coefficient * moved)

    def learn(self, common: Floats, untouched: Bools) -> None:
        """Take the common drift (K,) of each module's taxels since its zero [counts]; only
        `untouched` (K,) modules are used."""
        used = untouched & ~np.isnan(self._t0)
        forget = np.where(used, 1.0 - 1.0 / MEMORY, 1.0)
        weight = forget * self._weight + used
        gain = used / np.maximum(weight, 1.0)
        dx, dy = self._moved - self._x, np.where(used, common, 0.0) - self._y
        self._x, self._y = self._x + gain * dx, self._y + gain * dy
        new_dy = np.where(used, common, 0.0) - self._y
        self._xx = forget * self._xx + used * dx * (self._moved - self._x)
        self._xy = forget * self._xy + used * dx * new_dy
        self._yy = forget * self._yy + used * dy * new_dy
        self._weight = weight
        moves = self._xx > self._moves * np.maximum(weight, 1.0)
        slope = np.clip(self._xy / np.maximum(self._xx, 1.0), -COEFFICIENT_MAX, COEFFICIENT_MAX)
        explains = self._xy**2 >= EXPLAINS * self._xx * self._yy
        self.coefficient = np.where(moves, np.where(explains, slope, 0.0), self.coefficient)

    def _learn_leak(self, jump: Floats, press: Floats) -> None:
        """Learn from jumps (K,) of T0 and of the summed press [counts]."""
        used = (np.abs(press) > self._press_min) & ~np.isnan(jump)
        self._leak_xx[used] += press[used] ** 2
        self._leak_xy[used] += press[used] * jump[used]
        ratio = self._leak_xy / np.maximum(self._leak_xx, 1.0)
        self.leak = np.where(self._leak_xx > 0.0, np.clip(ratio, 0.0, LEAK_MAX), self.leak)
