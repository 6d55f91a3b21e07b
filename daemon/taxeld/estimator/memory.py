"""Memory of past scans: how well a pose explains which taxels were pressed before, and which not.

A sample proposed for one contact takes no other into account, and a particle that is moved must
still explain them all (after the memory unscented particle filter, Vezzani et al. 2017). Silent
scans are remembered beside contacts: where the skin met nothing, the object is not.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.estimator.offsets import Readings
from taxeld.estimator.prior import Prior
from taxeld.model.observation import Noise, Observation, ObservationModel

LIKELY = np.array([0.0, 0.85, 0.93, 1.0])  # of a reading: the activations that may explain it best


@dataclass(frozen=True, slots=True)
class Slack:
    """By how much a remembered scan may be off, in the plane."""

    robot_m: float = 0.0  # sd of the sensor's reported place, the same throughout a contact
    nudge_m: float = 0.0  # sd of what the object gives way at each contact since
    scale: float = 1.0  # of both, as the contacts show it

    def variance(self, age: Floats) -> Floats:
        """[m²] of scans that were followed by `age` contacts."""
        return np.asarray(self.scale**2 * (self.robot_m**2 + self.nudge_m**2 * age))


class Memory:
    """K scans to be explained by poses of the object in the world, and a prior that stands for all
    that was known before them, if there was anything."""

    def __init__(
        self,
        model: ObservationModel,
        noise: Noise,
        slack: Slack = Slack(),
        prior: Prior | None = None,
    ) -> None:
        taxels = len(model.layout)
        self._model = model
        self._noise = noise
        self.slack = slack
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
        self._ceiling = np.empty(0)  # (K,) log p(z | h) were each taxel pressed just as it reads

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

    @property
    def ceiling(self) -> Floats:
        """(K,) log p(z | h) were each taxel pressed just as it reads."""
        return self._ceiling

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
        self._ceiling = np.append(self._ceiling, density.max(axis=1).sum())

    def scan(self, k: int) -> Observation:
        """The k-th scan."""
        return Observation(
            self._sensor[k], self._z[k], self._live[k] > 0.0, self._floor[k], self._residue[k]
        )

    def only(self, kept: Bools, *, prior: bool = True) -> "Memory":
        """The scans that `kept` (K,) names, with the prior or without."""
        made = Memory(self._model, self._noise, self.slack, self.prior if prior else None)
        made.newest = self.newest
        for name in (
            "_sensor", "_z", "_live", "_floor", "_residue", "_weight", "_silent",
            "number", "pressed", "_ceiling",
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
        silent = self._silent[since:]
        k, n, taxels = len(silent), len(poses), len(self._model.layout)
        variance = self.slack.variance(self.newest - self.number[since:])
        slack = bool(variance.any())
        look_up = self._model.near_from if slack else self._model.pressed_from
        at, h, *gradient = look_up(self._sensor[since:], poses)
        row, taxel = np.divmod(at, taxels)
        cell = (row // max(n, 1) + since) * taxels + taxel
        z, floor = self._z.take(cell), self._floor.take(cell)
        added: Floats | float = 0.0
        if slack:
            readings = Readings(row, z, floor, h, *gradient, self._weight.take(cell))
            h, added = readings.offset(np.repeat(variance, n))
            h = np.clip(h, 0.0, 1.0)
        density = self._noise.log_density(z, h, floor, self._residue.take(cell))
        gain = (density - self._silent.take(cell)) * self._live.take(cell)
        met = np.bincount(row, gain, k * n) + added
        return np.asarray((met.reshape(k, n) + silent.sum(axis=1, keepdims=True)).T)
