"""Memory of past touches: how well a pose explains what was felt before.

A sample proposed for one touch knows nothing of the others. Algorithm 1 gives it the mean weight
all the same, and a belief that is right can lose to a sample that explains the present touch alone.
The memory weighs it (after the memory unscented particle filter, Vezzani et al. 2017).
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taxeld import se2
from taxeld.observation import Noise, ObservationModel
from taxeld.se2 import Poses

Floats = NDArray[np.float64]


class Touch(NamedTuple):
    """One judged scan."""

    sensor: Poses  # (3,) in the world
    z: Floats  # (M,)
    live: NDArray[np.bool_]  # (M,)


class TouchMemory:
    """The last `size` touches."""

    def __init__(self, model: ObservationModel, noise: Noise, size: int) -> None:
        self._model = model
        self._noise = noise
        self._touches: deque[Touch] = deque(maxlen=size)

    def clear(self) -> None:
        self._touches.clear()

    def add(self, touch: Touch, log_likelihood: Floats, remembered: Floats) -> Floats:
        """Remember a touch that a belief explains by `log_likelihood` (N,); → the belief's
        `remembered` (N, K) with it, and without the oldest touch where that is forgotten."""
        self._touches.append(touch)
        columns = np.column_stack([remembered, log_likelihood])
        return columns[:, -len(self._touches) :]

    def explain(self, poses: Poses) -> Floats:
        """log p(touch | pose) of each remembered touch: poses (N, 3) in the world → (N, K)."""
        if not self._touches:
            return np.empty((len(poses), 0))
        return np.column_stack([self.of(touch, poses) for touch in self._touches])

    def of(self, touch: Touch, poses: Poses) -> Floats:
        """log p(touch | pose): poses (N, 3) in the world → (N,)."""
        seen = se2.compose(se2.inverse(touch.sensor), poses)
        return self._model.log_likelihood(seen, touch.z, touch.live, self._noise)
