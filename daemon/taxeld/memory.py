"""Memory of past scans: how well a pose explains what was felt, and what was not, before.

A sample proposed for one touch knows nothing of the others, and a particle that is moved must still
explain them (after the memory unscented particle filter, Vezzani et al. 2017). Silence is
remembered beside touches: where the skin met nothing, the object is not.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld import se2
from taxeld.observation import Noise, ObservationModel
from taxeld.prior import Prior
from taxeld.se2 import Poses

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LIKELY = np.array([0.0, 0.85, 0.93, 1.0])  # of a reading: the activations that may explain it best


@dataclass(frozen=True, slots=True)
class Felt:
    """A scan as evidence: what was read where."""

    sensor: Poses  # (3,) in the world
    z: Floats  # (M,)
    live: Bools  # (M,)

    @property
    def touch(self) -> bool:
        """Whether anything was felt."""
        return bool(self.z.max() > 0.0)


class Memory:
    """K scans to be explained by poses of the object in the world. The first may stand for all that
    was known before: a prior."""

    def __init__(self, model: ObservationModel, noise: Noise, prior: Prior | None = None) -> None:
        taxels = len(model.layout)
        self._model = model
        self._noise = noise
        self._sensor = np.empty((0, 3))
        self._z = np.empty((0, taxels))
        self._live = np.empty((0, taxels))
        self._silent = np.empty((0, taxels))  # log p(z | h = 0): what a taxel says that is not met
        self.felt = np.empty(0, dtype=np.intp)  # (K,) taxels that felt anything; −1: a prior
        self.ceiling = np.empty(0)  # (K,) log p(z | h) were each taxel pressed just as it reads

        self._prior = prior
        if prior is not None:
            self.add(Felt(se2.IDENTITY, np.zeros(taxels), np.zeros(taxels, np.bool_)))
            self.felt[0], self.ceiling[0] = -1, prior.ceiling

    def __len__(self) -> int:
        return len(self._z)

    @property
    def touch(self) -> Bools:
        """(K,) whether anything was felt."""
        return np.asarray(self.felt > 0)

    @property
    def silent(self) -> Bools:
        """(K,) whether it is a scan in which nothing was."""
        return np.asarray(self.felt == 0)

    def add(self, felt: Felt) -> None:
        z = felt.z[:, None]
        density = self._noise.log_density(z, z * LIKELY) * felt.live[:, None]
        silent = density[:, 0]
        self._sensor = np.vstack([self._sensor, felt.sensor])
        self._z = np.vstack([self._z, felt.z])
        self._live = np.vstack([self._live, felt.live])
        self._silent = np.vstack([self._silent, silent])
        self.felt = np.append(self.felt, np.count_nonzero(felt.z))
        self.ceiling = np.append(self.ceiling, density.max(axis=1).sum())

    def scan(self, k: int) -> Felt:
        """The k-th scan."""
        return Felt(self._sensor[k], self._z[k], self._live[k] > 0.0)

    def only(self, kept: Bools) -> "Memory":
        """The scans that `kept` (K,) names."""
        made = Memory(self._model, self._noise)
        made._sensor = self._sensor[kept]
        made._z, made._live = self._z[kept], self._live[kept]
        made._silent = self._silent[kept]
        made._prior = self._prior if (self.felt[kept] < 0).any() else None
        made.felt, made.ceiling = self.felt[kept], self.ceiling[kept]
        return made

    def explain(self, poses: Poses, since: int = 0) -> Floats:
        """log p(scan | pose) over live taxels of scans from `since`: (N, 3) → (N, K − since)."""
        silent = self._silent[since:]
        k, n, taxels = len(silent), len(poses), len(self._model.layout)
        at, h = self._model.felt_from(self._sensor[since:], poses)
        row, taxel = np.divmod(at, taxels)
        cell = (row // max(n, 1) + since) * taxels + taxel
        density = self._noise.log_density(self._z.take(cell), h)
        gain = (density - self._silent.take(cell)) * self._live.take(cell)
        met = np.bincount(row, gain, k * n).reshape(k, n)
        explained = np.asarray((met + silent.sum(axis=1, keepdims=True)).T)
        if self._prior is not None and since == 0:
            explained[:, 0] += self._prior.log_density(poses)
        return explained
