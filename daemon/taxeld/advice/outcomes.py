"""What an approach would tell: which hypotheses its outcome would leave.

An outcome is how far the link gets until it touches, or that it touches nothing, and what it then
reads. Each hypothesis is taken for the truth in turn; the others are weighed by the outcome that it
would have.
"""

from typing import NamedTuple

import numpy as np

from taxeld.advice.hypotheses import Guesses
from taxeld.advice.lines import Lines
from taxeld.arrays import Floats, Index, Poses
from taxeld.estimator.estimate import SURE
from taxeld.estimator.estimator import Estimator
from taxeld.model import se2
from taxeld.model.observation import Observation

USELESS_M = 0.04  # m: an estimate that is farther off is of no use, however far
TRAVEL_SD_M = 0.002  # m: foam, shape and robot make a touch come so much sooner or later
MISS_M = 0.002  # m that a touch of nothing costs: only contacts make an estimate sure
LEAST = -8.0  # nats: least log-likelihood of an outcome, as nothing is certain


class Left(NamedTuple):
    """What C approaches would leave."""

    cost_m: Floats  # (C,) expected distance of estimate and object, and what misses cost
    sure: Floats  # (C,) probability that a mode is left that holds nearly all


class Outcomes:
    """Outcomes under hypotheses of one belief."""

    def __init__(self, estimator: Estimator, of: Guesses) -> None:
        self._estimator, self._of = estimator, of
        self._apart = _apart(estimator, of)
        self._near = (self._apart < estimator.config.within_m).astype(np.float64)
        self._like = [_like(estimator, link) for link in range(len(estimator.model.links))]
        self.now_m = float((self._apart @ of.weight).min())  # expected error as it is [m]

    def by_travel(self, travel_m: Floats) -> Left:
        """By the travel (C, K) until something is touched alone."""
        return self._left(np.exp(_met(travel_m)), travel_m)

    def by_reading(self, line: Lines, travel_m: Floats, depth_m: float) -> Left:
        """By the travel (K,) on one line, and by what is read `depth_m` farther on. Where no taxel
        would feel that, nothing is known to be touched."""
        hit = np.flatnonzero(np.isfinite(travel_m))
        sensor = line.after_each(travel_m[hit] + depth_m)
        z = self._felt(line.link, hit, sensor)
        felt_m = travel_m.copy()
        felt_m[hit[~z.any(axis=1)]] = np.inf
        told = _met(felt_m[None])[0]  # (truth, K)
        if len(hit):
            told[hit] += self._read(line.link, z, sensor)
        told = np.maximum(told - told.max(axis=1, keepdims=True), 2.0 * LEAST)
        return self._left(np.exp(told)[None], felt_m[None])

    def _felt(self, link: int, hit: Index, sensor: Poses) -> Floats:
        """(H, M) what would be read at sensor poses (H, 3), if the object were where hypotheses
        number `hit` (H,) have it."""
        of, like = self._of, self._like[link]
        z = np.zeros((len(hit), len(like.z)))
        for k in of.objects:
            own = of.object[hit] == k
            seen = se2.compose(se2.inverse(sensor[own]), of.pose[hit[own]])
            z[own] = self._estimator.known[k].model.links[link].activation(seen)
        return z * ((z >= like.floor) & like.live)

    def _read(self, link: int, z: Floats, sensor: Poses) -> Floats:
        """(H, K) log-likelihoods of readings z (H, M) at sensor poses (H, 3) by all hypotheses."""
        of, like = self._of, self._like[link]
        told = np.empty((len(z), len(of.weight)))
        for k in of.objects:
            own, memory = of.object == k, self._estimator.bank.mixtures[k].memory
            told[:, own] = memory.foreseen(like, z, sensor, of.pose[own]).T
        return told

    def _left(self, likelihood: Floats, travel_m: Floats) -> Left:
        """What outcomes of `likelihood` (C, truth, K) would leave, on lines with the travel (C,
        K)."""
        weight = self._of.weight
        left = likelihood * weight
        left /= left.sum(axis=2, keepdims=True)
        off = left @ self._apart  # (C, truth, K) expected distance from each hypothesis
        best = off.argmin(axis=2)
        loss = np.take_along_axis(off, best[:, :, None], axis=2)[:, :, 0]
        within = (left * self._near[best]).sum(axis=2)
        missed_m = MISS_M * (np.isinf(travel_m) @ weight)
        return Left(loss @ weight + missed_m, (within >= SURE) @ weight)


def _met(travel_m: Floats) -> Floats:
    """(C, truth, K) log-likelihoods of the travel (C, K) that each hypothesis would have."""
    far = np.where(np.isfinite(travel_m), travel_m, 1e3)
    off = (far[:, :, None] - far[:, None, :]) / TRAVEL_SD_M
    return np.maximum(-0.5 * off * off, LEAST)


def _apart(estimator: Estimator, of: Guesses) -> Floats:
    """(K, K) distances between hypotheses [m]; another object is USELESS_M off."""
    made = np.full((len(of.weight), len(of.weight)), USELESS_M)
    for k in of.objects:
        own = np.flatnonzero(of.object == k)
        pose, metric = of.pose[own], estimator.bank.rules[k].metric
        apart = metric.distance(pose[:, None], pose[None])
        made[np.ix_(own, own)] = np.minimum(apart, USELESS_M)
    return made


def _like(estimator: Estimator, link: int) -> Observation:
    """A silent scan of a link: its last one, or else what its skin is known for."""
    for observation, _ in reversed(estimator.history.scans):
        if observation.link == link and not observation.is_contact:
            return observation
    taxels = len(estimator.model.links[link].layout)
    return Observation(se2.IDENTITY, np.zeros(taxels), np.ones(taxels, np.bool_), link=link)
