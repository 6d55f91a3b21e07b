"""Foam that was pressed recovers slowly: what it still reads after a release is no touch."""

import numpy as np

from taxeld.arrays import Floats

RESIDUE = 0.1  # of a press, at most, is still read after its release
RECOVERY_S = 3.0  # time constant with which that fades


class Residue:
    """The last presses of M taxels."""

    def __init__(self, taxels: int) -> None:
        self._press = np.zeros(taxels)  # counts over baseline, fading as the foam recovers
        self._t = -np.inf

    def after(self, over: Floats, t: float) -> Floats:
        """(M,) counts over baseline that presses up to time t may have left, when `over` (M,) is
        read. A press counts in full at once, so it is never below its own residue."""
        if t > self._t:
            self._press *= np.exp(max(self._t - t, -100.0 * RECOVERY_S) / RECOVERY_S)
            self._t = t
        np.maximum(self._press, over, out=self._press)
        return RESIDUE * self._press
