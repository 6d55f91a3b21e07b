"""What an approach would tell: which hypotheses its outcome would leave.

An outcome is how far the link gets until it touches, or that it touches nothing, and what it then
reads. Each hypothesis is taken for the truth in turn; the others are weighed by the outcome that it
would have.
"""

from typing import NamedTuple

import numpy as np

from taxeld.advice.hypotheses import Guesses
from taxeld.advice.lines import Lines
from taxeld.arrays import Floats, Grid, Index, Poses, Reals
from taxeld.estimator.estimate import SURE
from taxeld.estimator.estimator import Estimator
from taxeld.model import se2
from taxeld.model.observation import Observation

USELESS_M = 0.04  # m: an estimate that is farther off is of no use, however far
TRAVEL_SD_M = 0.002  # m: foam, shape and robot make a touch come so much sooner or later
MISS_M = 0.002  # m that a touch of nothing costs: only contacts make an estimate sure
LEAST = -8.0  # nats: least log-likelihood of an outcome, as nothing is certain


class Left(NamedTuple):
    """What an approach would leave."""

    cost_m: float  # expected distance of estimate and object, and what misses cost
    sure: float  # probability that a mode is left that holds nearly all


class Outcomes:
    """Outcomes under hypotheses of one belief."""

    def __init__(self, estimator: Estimator, of: Guesses) -> None:
        self._estimator, self._of = estimator, of
        self._apart = _apart(estimator, of)
        self._near = (self._apart < estimator.config.within_m).astype(np.float32)
        self._like = [_like(estimator, link) for link in range(len(estimator.model.links))]
        self.now_m = float((self._apart @ of.weight).min())  # expected error as it is [m]

    def by_travel(self, travel_m: Floats) -> Floats:
        """(C,) costs [m], as of `Left`, by the travel (C, K) until something is touched alone."""
        off = self._left(np.exp(_met(travel_m))) @ self._apart
        return np.asarray(off.min(axis=2) @ self._of.weight + self._missed_m(travel_m))

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
        left = self._left(np.exp(told))
        off = left @ self._apart  # (truth, K) expected distance from each hypothesis
        best, weight = off.argmin(axis=1), self._of.weight
        within = (left * self._near[best]).sum(axis=1)
        cost_m = off.min(axis=1) @ weight + self._missed_m(felt_m)
        return Left(float(cost_m), float((within >= SURE) @ weight))

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
            own, memory = of.object == k, self._estimator.bank.rules[k].memory
            told[:, own] = memory.foreseen(like, z, sensor, of.pose[own]).T
        return told

    def _left(self, likelihood: Reals) -> Grid:
        """(…, truth, K) weights that outcomes of `likelihood` (…, truth, K) would leave."""
        left = likelihood.astype(np.float32) * self._of.weight.astype(np.float32)
        left /= left.sum(axis=-1, keepdims=True)
        return left

    def _missed_m(self, travel_m: Floats) -> Floats:
        """(…) what it costs that nothing is touched, on lines with the travel (…, K)."""
        return np.asarray(MISS_M * (np.isinf(travel_m) @ self._of.weight))


def _met(travel_m: Floats) -> Grid:
    """(C, truth, K) log-likelihoods of the travel (C, K) that each hypothesis would have."""
    far = np.where(np.isfinite(travel_m), travel_m / TRAVEL_SD_M, 1e6).astype(np.float32)
    off = far[:, :, None] - far[:, None, :]
    return np.maximum(-0.5 * off * off, LEAST)


def _apart(estimator: Estimator, of: Guesses) -> Grid:
    """(K, K) distances between hypotheses [m]; another object is USELESS_M off."""
    made = np.full((len(of.weight), len(of.weight)), USELESS_M, np.float32)
    for k in of.objects:
        own = np.flatnonzero(of.object == k)
        pose, metric = of.pose[own], estimator.bank.rules[k].metric
        apart = metric.distance(pose[:, None], pose[None])
        made[np.ix_(own, own)] = np.minimum(apart, USELESS_M)
    return made


def _like(estimator: Estimator, link: int) -> Observation:
    """A scan of a link: its last one that is remembered, or else what its skin is known for."""
    for scan in reversed(estimator.scans):
        if scan.observation.link == link:
            return scan.observation
    taxels = len(estimator.model.links[link].layout)
    return Observation(se2.IDENTITY, np.zeros(taxels), np.ones(taxels, np.bool_), link=link)
