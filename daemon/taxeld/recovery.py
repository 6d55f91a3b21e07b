"""Foam that was pressed is not flat at once: what it still reads after a release is no touch."""

import numpy as np
from numpy.typing import NDArray

RESIDUE = 0.1  # of a press at most stays behind for a while
RECOVERY_S = 3.0  # in which all but 1/e of that is gone

Floats = NDArray[np.float64]


class Recovery:
    """The last presses of M taxels."""

    def __init__(self, taxels: int) -> None:
        self._press = np.zeros(taxels)  # counts over baseline, fading as the foam recovers
        self._t = -np.inf

    def residue(self, over: Floats, t: float) -> Floats:
        """(M,) counts over baseline that may be left of presses up to time t, when `over` (M,) is
        read. A press is never its own residue."""
        if t > self._t:
            self._press *= np.exp(max(self._t - t, -100.0 * RECOVERY_S) / RECOVERY_S)
            self._t = t
        np.maximum(self._press, over, out=self._press)
        return RESIDUE * self._press

    def clock_stepped(self, by: float) -> None:
        """The clock was set."""
        self._t += by
