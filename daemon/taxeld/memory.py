"""Memory of past touches: how well a pose explains what was felt before.

A sample proposed for one touch knows nothing of the others. Algorithm 1 gives it the mean weight
all the same, and a belief that is right can lose to a sample that explains the present touch alone.
The memory weighs it (after the memory unscented particle filter, Vezzani et al. 2017).
"""

import numpy as np
from numpy.typing import NDArray

from taxeld import se2
from taxeld.observation import Noise, ObservationModel
from taxeld.se2 import Poses

Floats = NDArray[np.float64]


class Touches:
    """K scans to be explained, each by any pose of the object in the world."""

    def __init__(self, model: ObservationModel, noise: Noise) -> None:
        taxels = len(model.layout)
        self._model = model
        self._noise = noise
        self._world_in_sensor = np.empty((0, 3))
        self._z = np.empty((0, taxels))
        self._live = np.empty((0, taxels))
        self._silent = np.empty((0, taxels))  # log p(z | h = 0): what a taxel says that is not met

    def __len__(self) -> int:
        return len(self._z)

    def add(self, sensor: Poses, z: Floats, live: NDArray[np.bool_]) -> None:
        """A scan z, live (M,) with the sensor at a pose (3,) in the world."""
        silent = np.where(live, self._noise.log_density(z, np.zeros(1)), 0.0)
        self._world_in_sensor = np.vstack([self._world_in_sensor, se2.inverse(sensor)])
        self._z = np.vstack([self._z, z])
        self._live = np.vstack([self._live, live])
        self._silent = np.vstack([self._silent, silent])

    def keep_last(self, count: int) -> None:
        """Forget all but the last `count` scans."""
        self._world_in_sensor = self._world_in_sensor[-count:]
        self._z, self._live = self._z[-count:], self._live[-count:]
        self._silent = self._silent[-count:]

    def explain(self, poses: Poses) -> Floats:
        """log p(scan | pose) over live taxels: poses (N, 3) in the world → (N, K)."""
        k, n, taxels = len(self), len(poses), len(self._model.layout)
        seen = se2.compose(self._world_in_sensor[:, None], poses[None]).reshape(k * n, 3)
        at, h = self._model.felt(seen)
        row, taxel = np.divmod(at, taxels)
        cell = row // max(n, 1) * taxels + taxel
        density = self._noise.log_density(self._z.take(cell), h)
        gain = (density - self._silent.take(cell)) * self._live.take(cell)
        met = np.bincount(row, gain, k * n).reshape(k, n)
        return np.asarray((met + self._silent.sum(axis=1, keepdims=True)).T)
