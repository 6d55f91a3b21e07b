"""Memory of past scans: how well a pose explains which taxels were pressed before, and which not.

A sample proposed for one contact takes no other into account, and a particle that is moved must
still explain them all (after the memory unscented particle filter, Vezzani et al. 2017). Silent
scans are remembered beside contacts: where the skin met nothing, the object is not.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Grid, Index, Poses
from taxeld.estimator.offsets import Readings
from taxeld.estimator.prior import Prior
from taxeld.model.observation import Nearby, Noise, Observation, ObservationModel

HIDDEN = 1.5  # standard deviations of its offset that a silent scan may be off
LIKELY = np.array([0.0, 0.85, 0.93, 1.0])  # of a reading: the activations that may explain it best


@dataclass(frozen=True, slots=True)
class Slack:
    """By how much a remembered scan may be off, in the plane."""

    robot_m: float = 0.0  # sd of the sensor's reported place, the same throughout a contact
    nudge_m: float = 0.0  # sd of what the object gives way at each contact since
    scale: float = 1.0  # of both, as the contacts show it

    def variance(self, age: NDArray[np.intp]) -> Floats:
        """[m²] of scans that were followed by `age` contacts."""
        return np.asarray(self.scale**2 * (self.robot_m**2 + self.nudge_m**2 * age))


class Memory:
    """K scans to be explained by poses of the object in the world, and a prior that stands for all
    that was known before them, if there was anything."""

    def __init__(
        self,
        model: ObservationModel,
        noise: Noise,
        prior: Prior | None = None,
        slack: Slack | None = None,
    ) -> None:
        taxels = len(model.layout)
        self._model = model
        self._noise = noise
        self.slack = slack or Slack()
        self.prior = prior
        self._sensor = np.empty((0, 3))
        none = np.empty((0, taxels), np.float32)
        self._z = self._live = self._floor = self._residue = none
        self._level = none  # what is read, or the floor where that is 0
        self._low = self._high = none  # that a reading may be said to be above what is expected
        self._root = none  # 1 / standard deviation about what is read, 0 where not live
        self._silent = none  # log p(z | h = 0): of a taxel that is not pressed
        self.number = np.empty(0, dtype=np.intp)  # (K,) of the contact; the last, where silent
        self.newest = 0  # number of the contact that began last
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

    @property
    def contacts(self) -> int:
        """How many the scans are of."""
        return len(np.unique(self.number[self.contact]))

    @property
    def share(self) -> Floats:
        """(terms,) by which each counts: a contact counts once, however many scans are of it."""
        share = np.ones(self.terms)
        of_scans = self.of_scans(share)
        touched = self.contact
        _, which, count = np.unique(self.number[touched], return_inverse=True, return_counts=True)
        of_scans[touched] = 1.0 / count[which]
        return share

    def add(self, observation: Observation, number: int = 0) -> None:
        """A scan of the contact of that number, or a silent one after it."""
        z, live = observation.z, observation.live
        floor = np.broadcast_to(observation.floor, len(z))
        residue = np.broadcast_to(observation.residue, len(z))
        density = self._noise.log_density(
            z[:, None], z[:, None] * LIKELY, floor[:, None], residue[:, None]
        )
        density = density * live[:, None]
        kept = {
            "_z": z,
            "_live": live,
            "_floor": floor,
            "_residue": residue,
            "_level": np.where(z > 0.0, z, floor),
            "_low": np.where(z < 1.0, -np.inf, 0.0),
            "_high": np.where(z > 0.0, np.inf, 0.0),
            "_root": live / np.sqrt(self._noise.variance(z) + residue**2),
            "_silent": density[:, 0],
        }
        for name, values in kept.items():
            grown = np.vstack([getattr(self, name), values.astype(np.float32)])
            setattr(self, name, grown)
        self._sensor = np.vstack([self._sensor, observation.sensor])
        self.number = np.append(self.number, number)
        self.newest = max(self.newest, number)
        self.pressed = np.append(self.pressed, np.count_nonzero(z))
        self.ceiling = np.append(self.ceiling, density.max(axis=1).sum())

    def scan(self, k: int) -> Observation:
        """The k-th scan."""
        return Observation(
            self._sensor[k], self._z[k], self._live[k] > 0.0, self._floor[k], self._residue[k]
        )

    def only(self, kept: Bools, *, prior: bool = True) -> "Memory":
        """The scans that `kept` (K,) names, with the prior or without."""
        made = Memory(self._model, self._noise, self.prior if prior else None, self.slack)
        made.newest = self.newest
        for name in (
            "_sensor", "_z", "_live", "_floor", "_residue", "_level", "_low", "_high", "_root",
            "_silent", "number", "pressed", "ceiling",
        ):  # fmt: skip
            setattr(made, name, getattr(self, name)[kept])
        return made

    def slack_m(self, k: int) -> float:
        """Standard deviation of the k-th scan's offset [m]."""
        return float(np.sqrt(self.slack.variance(self.newest - self.number[k])))

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
        """Of scans from `since` on: (N, 3) → (N, K − since). Contacts have an offset each; a silent
        scan tells of what presses deeper than its offset may have hidden."""
        n, k = len(poses), len(self) - since
        variance = self.slack.variance(self.newest - self.number[since:])
        silent = self.silent[since:]
        order = np.argsort(silent, kind="stable")  # contacts first
        about = k - int(np.count_nonzero(silent)) if variance.any() else 0
        near = self._model.pressed_from(self._sensor[since:][order], poses, about)
        scan = order.take(near.row // max(n, 1))
        cell = (scan + since) * len(self._model.layout) + near.taxel
        depth, added, pairs = near.depth, np.zeros(k * n), len(near.gx)
        if pairs:
            offset = self._readings(near, cell).offset(np.repeat(variance[order[:about]], n))
            depth[:pairs], added[: about * n] = offset
        hidden = (HIDDEN / self._model.depth_max_m) * np.sqrt(variance)
        depth[pairs:] -= hidden.astype(np.float32).take(scan[pairs:])
        gain = self._gain(cell, np.minimum(np.maximum(depth, 0.0), 1.0))
        explained = np.empty((n, k))
        explained[:, order] = (np.bincount(near.row, gain, k * n) + added).reshape(k, n).T
        explained += self._silent[since:].sum(axis=1, dtype=np.float64)
        return explained

    def _readings(self, near: Nearby, cell: Index) -> Readings:
        """Of taxels about a press, at these places in what is kept."""
        pairs = len(near.gx)
        cell = cell[:pairs]
        level, low, high, root = (
            kept.take(cell) for kept in (self._level, self._low, self._high, self._root)
        )
        row, depth = near.row[:pairs], near.depth[:pairs]
        return Readings(row, level, low, high, depth, near.gx, near.gy, root)

    def _gain(self, cell: Index, h: Grid) -> Floats:
        """By how much readings at places in what is kept are likelier at h than untouched."""
        z, floor, residue, silent, live = (
            kept.take(cell)
            for kept in (self._z, self._floor, self._residue, self._silent, self._live)
        )
        return np.asarray((self._noise.log_density(z, h, floor, residue) - silent) * live)
