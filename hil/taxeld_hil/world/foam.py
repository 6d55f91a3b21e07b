"""Foam under the electrodes: what it adds while a press recedes, and what it keeps of one."""

import numpy as np

from taxeld.arrays import Floats
from taxeld_hil.scenario.mesh_config import MeshConfig
from taxeld_hil.world.spread import PerPress, drawn

TURN = 0.1  # travel back, in full scales, after which the foam is on its other branch


class Foam:
    """Hysteresis and residue: readings (M,) in shares of full scale, scan by scan.

    Hysteresis: while a press deepens, the reading itself is read; while it recedes, more by the
    taxel's share of it. This loop closes, does not depend on speed, and is zero at 0 (after Dahl's
    model of friction).

    Residue: a share of a press stays when it is over. It is the sum of two parts, one soon gone and
    one long felt, each with the share of this taxel and press. While a part is below its share of
    what is read it grows towards it with the time constant `loading_s`, so a tap leaves less and
    what presses leave adds up, but never beyond the share; else it decays with its own.
    """

    def __init__(self, config: MeshConfig, taxels: int, rng: np.random.Generator) -> None:
        self._loop = drawn(config.hysteresis, rng.standard_normal(taxels))
        pairs = config.residue, config.residue_slow
        self._share = [PerPress(pair, taxels, rng) for pair in pairs]
        self._fading_s = np.array([[config.residue_s], [config.residue_slow_s]])
        self._loading_s = config.loading_s
        self._left = np.zeros((2, taxels))
        self._reading, self._receding = np.zeros((2, taxels))
        self._t = np.inf

    def press(self, reading: Floats, t: float) -> Floats:
        """Readings (M,) of the foam at time t [s] for ideal readings (M,); times do not go back."""
        step = reading - self._reading
        self._receding = np.clip(self._receding - step / TURN, 0.0, 1.0)
        target = np.stack([share.now for share in self._share]) * reading
        rate_s = np.where(target > self._left, self._loading_s, self._fading_s)
        self._left += (target - self._left) * -np.expm1(-max(t - self._t, 0.0) / rate_s)
        self._reading, self._t = reading, t
        held = reading * (1.0 + self._loop * self._receding)
        return np.asarray(np.maximum(held, self._left.sum(axis=0)))

    def end(self) -> None:
        """A press is over: the next one has shares of its own."""
        for share in self._share:
            share.draw()
