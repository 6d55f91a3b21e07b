"""Memory of past scans: how well a pose explains which taxels were pressed before, and which not.

A sample proposed for one contact takes no other into account, and a particle that is moved must
still explain them all (after the memory unscented particle filter, Vezzani et al. 2017). Silent
scans are remembered beside contacts: where the skin met nothing, the object is not.
"""

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.estimator.prior import Prior
from taxeld.model.observation import Noise, Observation, ObservationModel

LIKELY = np.array([0.0, 0.85, 0.93, 1.0])  # of a reading: the activations that may explain it best


class Memory:
    """K scans to be explained by poses of the object in the world, and a prior that stands for all
    that was known before them, if there was anything."""

    def __init__(self, model: ObservationModel, noise: Noise, prior: Prior | None = None) -> None:
        taxels = len(model.layout)
        self._model = model
        self._noise = noise
        self.prior = prior
        self._sensor = np.empty((0, 3))
        self._z = np.empty((0, taxels))
        self._live = np.empty((0, taxels))
        self._floor = np.empty((0, taxels))
        self._residue = np.empty((0, taxels))
        self._silent = np.empty((0, taxels))  # log p(z | h = 0): of a taxel that is not pressed
        self.pressed = np.empty(0, dtype=np.intp)  # (K,) taxels that were pressed
        self.ceiling = np.empty(0)  # (K,) log p(z | h) were each taxel pressed just as it reads

    def __len__(self) -> int:
        return len(self._z)

    @property
    def terms(self) -> int:
        """Columns of `explain`: the prior's, if there is one, and then one a scan."""
        return len(self) + (self.prior is not None)

    @property
    def contact(self) -> Bools:
        """(K,) whether any taxel was pressed."""
        return np.asarray(self.pressed > 0)

    @property
    def silent(self) -> Bools:
        """(K,) whether none was."""
        return np.asarray(self.pressed == 0)

    def add(self, observation: Observation) -> None:
        z = observation.z[:, None]
        floor = np.broadcast_to(observation.floor, len(z))
        residue = np.broadcast_to(observation.residue, len(z))
        density = self._noise.log_density(z, z * LIKELY, floor[:, None], residue[:, None])
        density = density * observation.live[:, None]
        self._sensor = np.vstack([self._sensor, observation.sensor])
        self._z = np.vstack([self._z, observation.z])
        self._live = np.vstack([self._live, observation.live])
        self._floor = np.vstack([self._floor, floor])
        self._residue = np.vstack([self._residue, residue])
        self._silent = np.vstack([self._silent, density[:, 0]])
        self.pressed = np.append(self.pressed, np.count_nonzero(observation.z))
        self.ceiling = np.append(self.ceiling, density.max(axis=1).sum())

    def scan(self, k: int) -> Observation:
        """The k-th scan."""
        return Observation(
            self._sensor[k], self._z[k], self._live[k] > 0.0, self._floor[k], self._residue[k]
        )

    def only(self, kept: Bools, *, prior: bool = True) -> "Memory":
        """The scans that `kept` (K,) names, with the prior or without."""
        made = Memory(self._model, self._noise, self.prior if prior else None)
        made._sensor = self._sensor[kept]
        made._z, made._live = self._z[kept], self._live[kept]
        made._silent = self._silent[kept]
        made._floor, made._residue = self._floor[kept], self._residue[kept]
        made.pressed, made.ceiling = self.pressed[kept], self.ceiling[kept]
        return made

    def of_scans(self, explained: Floats) -> Floats:
        """(…, terms) as `explain` has them → (…, K) without the prior's."""
        return explained[..., self.terms - len(self) :]

    def explain(self, poses: Poses) -> Floats:
        """Log-density of the prior, if there is one, and log p(scan | pose) over live taxels of
        each scan: (N, 3) → (N, terms)."""
        explained = self._explain(poses, 0)
        if self.prior is None:
            return explained
        return np.hstack([self.prior.log_density(poses)[:, None], explained])

    def explain_newest(self, poses: Poses) -> Floats:
        """log p(scan | pose) of the scan that was added last: (N, 3) → (N,)."""
        return self._explain(poses, len(self) - 1)[:, 0]

    def _explain(self, poses: Poses, since: int) -> Floats:
        """Of scans from `since` on: (N, 3) → (N, K − since)."""
        silent = self._silent[since:]
        k, n, taxels = len(silent), len(poses), len(self._model.layout)
        at, h = self._model.pressed_from(self._sensor[since:], poses)
        row, taxel = np.divmod(at, taxels)
        cell = (row // max(n, 1) + since) * taxels + taxel
        density = self._noise.log_density(
            self._z.take(cell), h, self._floor.take(cell), self._residue.take(cell)
        )
        gain = (density - self._silent.take(cell)) * self._live.take(cell)
        met = np.bincount(row, gain, k * n).reshape(k, n)
        return np.asarray((met + silent.sum(axis=1, keepdims=True)).T)
