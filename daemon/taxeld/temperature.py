"""What a module's temperature T0 explains of the drift that its taxels have in common.

The coefficient is a regression, out of contact and forgetting, of the module's common drift on the
way that T0 has gone. T0 also sees a little of every press, which is no temperature: that share is
learned from jumps of both within one slice, and taken off.
"""

import numpy as np

from taxeld.idle import Bools, Floats

MEMORY = 1800.0  # slices of a second: evidence older than this has faded
TELLS = 0.002  # of full scale: sd of T0 that says something about drift
EXPLAINS = 0.5  # share of the common drift's variance, else the coefficient is nothing
COEFFICIENT_MAX = 5.0  # counts a count of T0
LEAK_MAX = 0.5
PRESS = 0.02  # of full scale: change of a module's summed press that says something about the leak
STEP = 0.005  # of full scale, in one slice: more is no temperature but a new zero of the channel


class Temperature:
    """T0 of K modules; a module without one is nan throughout, and is explained nothing."""

    def __init__(self, modules: int, full_scale: float) -> None:
        self.coefficient: Floats = np.zeros(modules)
        self.leak: Floats = np.zeros(modules)
        self.steps = 0
        self._tells = (TELLS * full_scale) ** 2
        self._press_min = PRESS * full_scale
        self._step_max = STEP * full_scale
        self._t0 = np.full(modules, np.nan)
        self._press = np.zeros(modules)
        self._leak_xx, self._leak_xy = np.zeros(modules), np.zeros(modules)
        self._way = np.zeros(modules)  # that T0 has gone
        self.forget_drift()

    @property
    def level(self) -> Floats:
        """T0 without what it saw of a press, last known (K,)."""
        return np.asarray(self._t0 - self.leak * self._press)

    def set_leak(self, leak: Floats) -> None:
        """A leak that was learned before; new presses soon outweigh it."""
        self.leak = leak.copy()
        self._leak_xx[:] = self._press_min**2
        self._leak_xy = leak * self._leak_xx

    def forget_drift(self) -> None:
        """The common drift has a new zero."""
        modules = len(self._way)
        self._weight, self._x, self._y = np.zeros(modules), np.zeros(modules), np.zeros(modules)
        self._xx, self._xy, self._yy = np.zeros(modules), np.zeros(modules), np.zeros(modules)

    def on_slice(self, t0: Floats, press: Floats) -> Floats:
        """T0 and the sum of what the taxels read over their baselines, by module (K,), means over a
        slice; → by how much the taxels' idle reading has moved with T0 [counts]."""
        heard = ~np.isnan(t0)
        by, pressed = t0 - self._t0, press - self._press
        self._learn_leak(by, pressed)
        moved = np.nan_to_num(by - self.leak * pressed)
        stepped = np.abs(moved) > self._step_max
        self.steps += int(stepped.sum())
        moved[stepped] = 0.0
        self._t0 = np.where(heard, t0, self._t0)
        self._press = np.where(heard, press, self._press)
        self._way += moved
        return np.asarray(self.coefficient * moved)

    def learn(self, common: Floats, told: Bools) -> None:
        """The drift that the taxels of each module have in common since its zero (K,), where
        `told`: out of contact."""
        told = told & ~np.isnan(self._t0)
        forget = np.where(told, 1.0 - 1.0 / MEMORY, 1.0)
        weight = forget * self._weight + told
        gain = told / np.maximum(weight, 1.0)
        dx, dy = self._way - self._x, np.where(told, common, 0.0) - self._y
        self._x, self._y = self._x + gain * dx, self._y + gain * dy
        new_dy = np.where(told, common, 0.0) - self._y
        self._xx = forget * self._xx + told * dx * (self._way - self._x)
        self._xy = forget * self._xy + told * dx * new_dy
        self._yy = forget * self._yy + told * dy * new_dy
        self._weight = weight
        tells = self._xx > self._tells * np.maximum(weight, 1.0)
        slope = np.clip(self._xy / np.maximum(self._xx, 1.0), -COEFFICIENT_MAX, COEFFICIENT_MAX)
        explains = self._xy**2 >= EXPLAINS * self._xx * self._yy
        self.coefficient = np.where(tells, np.where(explains, slope, 0.0), self.coefficient)

    def _learn_leak(self, jump: Floats, press: Floats) -> None:
        told = (np.abs(press) > self._press_min) & ~np.isnan(jump)
        self._leak_xx[told] += press[told] ** 2
        self._leak_xy[told] += press[told] * jump[told]
        ratio = self._leak_xy / np.maximum(self._leak_xx, 1.0)
        self.leak = np.where(self._leak_xx > 0.0, np.clip(ratio, 0.0, LEAK_MAX), self.leak)
