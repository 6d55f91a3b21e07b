"""Memory of past scans: how well a pose explains which taxels were pressed before, and which not.

A sample proposed for one contact takes no other into account, and a particle that is moved must
still explain them all (after the memory unscented particle filter, Vezzani et al. 2017). Silent
scans are remembered beside contacts: where the skin met nothing, the object is not.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Poses
from taxeld.estimator.offsets import Readings
from taxeld.estimator.prior import Prior
from taxeld.model.observation import Noise, Observation, ObservationModel

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
        self._z = np.empty((0, taxels))
        self._live = np.empty((0, taxels))
        self._floor = np.empty((0, taxels))
        self._residue = np.empty((0, taxels))
        self._weight = np.empty((0, taxels))  # 1 / variance about what is read, 0 where not live
        self._silent = np.empty((0, taxels))  # log p(z | h = 0): of a taxel that is not pressed
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
        z = observation.z[:, None]
        floor = np.broadcast_to(observation.floor, len(z))
        residue = np.broadcast_to(observation.residue, len(z))
        density = self._noise.log_density(z, z * LIKELY, floor[:, None], residue[:, None])
        density = density * observation.live[:, None]
        weight = observation.live / (self._noise.variance(observation.z) + residue**2)
        self._sensor = np.vstack([self._sensor, observation.sensor])
        self._z = np.vstack([self._z, observation.z])
        self._live = np.vstack([self._live, observation.live])
        self._floor = np.vstack([self._floor, floor])
        self._residue = np.vstack([self._residue, residue])
        self._weight = np.vstack([self._weight, weight])
        self._silent = np.vstack([self._silent, density[:, 0]])
        self.number = np.append(self.number, number)
        self.newest = max(self.newest, number)
        self.pressed = np.append(self.pressed, np.count_nonzero(observation.z))
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
            "_sensor", "_z", "_live", "_floor", "_residue", "_weight", "_silent",
            "number", "pressed", "ceiling",
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
        """Of scans from `since` on: (N, 3) → (N, K − since)."""
        explained = np.repeat(self._silent[since:].sum(axis=1)[None], len(poses), axis=0)
        variance = self.slack.variance(self.newest - self.number[since:])
        touched = self.contact[since:] & (variance > 0.0)
        for chosen, met in ((touched, self._met_about), (~touched, self._met)):
            rows = np.flatnonzero(chosen)
            if len(rows):
                explained[:, rows] += met(poses, rows + since, variance[rows])
        return explained

    def _met(self, poses: Poses, scans: NDArray[np.intp], variance: Floats) -> Floats:
        """What taxels that poses press add to log p of scans (k,): (N, k). A silent scan tells of
        what presses deeper than its offset may have hidden."""
        at, h = self._model.pressed_from(self._sensor[scans], poses)
        row, cell = self._pairs(at, scans, len(poses))
        hidden = HIDDEN * np.sqrt(variance) / self._model.depth_max_m
        h = np.maximum(h - hidden.take(row // len(poses)), 0.0)
        gain = self._gain(cell, h, self._floor.take(cell))
        met = np.bincount(row, gain, len(scans) * len(poses))
        return np.asarray(met.reshape(len(scans), -1).T)

    def _met_about(self, poses: Poses, scans: NDArray[np.intp], variance: Floats) -> Floats:
        """The same where each scan has an offset of its own."""
        at, depth, gx, gy = self._model.near_from(self._sensor[scans], poses)
        row, cell = self._pairs(at, scans, len(poses))
        z, floor = self._z.take(cell), self._floor.take(cell)
        readings = Readings(row, z, floor, depth, gx, gy, self._weight.take(cell))
        depth, added = readings.offset(np.repeat(variance, len(poses)))
        gain = self._gain(cell, np.clip(depth, 0.0, 1.0), floor)
        met = np.bincount(row, gain, len(added)) + added
        return np.asarray(met.reshape(len(scans), -1).T)

    def _pairs(
        self, at: NDArray[np.intp], scans: NDArray[np.intp], poses: int
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices into (k, N, M) → rows of (k · N), and places in what is kept, (K, M)."""
        row, taxel = np.divmod(at, len(self._model.layout))
        return row, scans.take(row // max(poses, 1)) * len(self._model.layout) + taxel

    def _gain(self, cell: NDArray[np.intp], h: Floats, floor: Floats) -> Floats:
        """By how much readings at places in what is kept are likelier at h than untouched."""
        density = self._noise.log_density(self._z.take(cell), h, floor, self._residue.take(cell))
        return np.asarray((density - self._silent.take(cell)) * self._live.take(cell))
