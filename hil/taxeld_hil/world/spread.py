"""Differences between taxels and between presses: lognormals by two quantiles."""

import numpy as np

from taxeld.arrays import Floats
from taxeld_hil.scenario.mesh_config import Pair

P90 = 1.2815515655446004  # the 90th percentile of a standard normal
FARTHEST = 2.0  # standard deviations: nothing is drawn beyond the 2nd and the 98th percentile


def drawn(pair: Pair, normal: Floats | float) -> Floats:
    """Values of a lognormal of a median and a 90th percentile, at standard normals of any shape."""
    median, p90 = pair
    rate = np.log(p90 / median) / P90 if median else 0.0
    return np.asarray(median * np.exp(rate * np.clip(normal, -FARTHEST, FARTHEST)))


class PerPress:
    """A property that is a taxel's own in half of its variance, and in the other half a press's,
    the same for all taxels: the recordings do not tell the two apart, so the halves are assumed."""

    def __init__(self, pair: Pair, taxels: int, rng: np.random.Generator) -> None:
        self._pair, self._rng = pair, rng
        self._own = rng.standard_normal(taxels)
        self.draw()

    def draw(self) -> None:
        """Another press."""
        press = self._rng.standard_normal()
        self.now = drawn(self._pair, np.sqrt(0.5) * (self._own + press))  # (M,)
