"""Pressed foam recovers slowly: its reading after a release is no touch.

How much stays, and for how long, differs from taxel to taxel and from press to press, so it is
followed and not predicted. A press that has fallen to a share of its own peak is over. From then on
the reading is the foam's, as long as it only falls; a rise above that is the next press.
"""

import numpy as np

from taxeld.arrays import Bools, Floats

KEPT = 0.4  # share of a press's peak: a lower reading is of a released press
FRESH = 0.1  # share of a scan in the mean reading after a release: a single one is noisy


class Residue:
    """The last presses of M taxels."""

    def __init__(self, taxels: int) -> None:
        self.level: Floats = np.zeros(taxels)  # (M,) counts over baseline left by presses
        self.pressed: Bools = np.zeros(taxels, dtype=bool)  # (M,)
        self.is_none = True  # nothing is pressed, and nothing is left
        self._peak = np.zeros(taxels)  # (M,) peak of the press under way [counts]
        self._mean = np.zeros(taxels)  # (M,) mean reading since the release [counts]

    def on_scan(self, over: Floats, threshold: Floats) -> None:
        """Take counts (M,) over baseline; a rise by `threshold` (M,) is a press."""
        level, pressed = self.level, self.pressed
        if self.is_none and not (over > threshold).any():
            self._peak = over
            return
        mean = self._mean + FRESH * (over - self._mean)
        mean = np.where(over < mean - threshold, over, mean)  # a fall, and no noise
        level = np.where(pressed, level, np.minimum(np.maximum(mean, 0.0), level))
        peak = np.where(pressed, np.maximum(self._peak, over), over)
        pressed = pressed | (over > level + threshold)
        ended = pressed & (over <= level + KEPT * (peak - level))
        self.level = np.where(ended, np.maximum(over, 0.0), level)
        self._mean = np.where(ended, over, mean)
        self.pressed, self._peak = pressed & ~ended, peak
        self.is_none = not (self.pressed.any() or self.level.any())
