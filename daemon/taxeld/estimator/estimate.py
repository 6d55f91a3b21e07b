"""The estimate: the belief in short, in probabilities, and the status that they make."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.particles import Particles
from taxeld.model.noise import normal_cdf
from taxeld.model.symmetry import Mode, PoseMetric

# Lengths are for an object of 0.05 m mean radius; they scale with the object.
MODE_RADIUS_M = 0.02  # root-mean-square displacement of surface points
MODES_MAX = 5
MODE_CANDIDATES = 32
SURE = 0.99  # least p of a converged estimate
SEARCHING_WEIGHT = 0.2  # least weight of the heaviest mode: a lighter one is not worth reporting
UNMODELLED_M = 0.002  # sd of the pose beside the belief's own: robot, foam and shape err unmodelled


class Status(IntEnum):
    """How far the estimate can be used."""

    STARTING = 0  # the idle baseline is being learned
    SEARCHING = 1  # nothing touched yet, or too little
    AMBIGUOUS = 2  # several modes explain the contacts
    CONVERGED = 3  # p is at least SURE
    BLIND = 4  # no live taxel, or none where contact is expected
    STALE = 5  # no fresh scan or sensor pose
    INCONSISTENT = 6  # another object, or one that has moved, is likelier


class ProposalKind(IntEnum):
    """Which proposal served the last injection."""

    NONE = 0
    PROJECTION = 1
    DDPM = 2
    TABLE = 3
    MANIFOLD = 4
    DENSITY = 5


class Hypotheses(NamedTuple):
    """Probabilities of what was touched; they sum to 1."""

    stands: float = 1.0  # this object, which has stood since the oldest remembered contact
    moved: float = 0.0  # this object, moved between two remembered contacts
    other: float = 0.0  # something else


@dataclass(frozen=True, slots=True)
class Estimate:
    """The belief in short; poses are of the object in the world."""

    t: float  # time of the scan [s]
    status: Status
    contact: bool
    contacts: int  # contacts begun since reset
    map: Poses  # (3,) mean of the heaviest mode
    mean: Poses  # (3,)
    cov: Poses  # (3, 3) covariance about the mean, turns up to symmetry
    modes: tuple[Mode, ...]
    p: float  # probability that it is this object and within `filter.within_m` of `map`
    radius_m: float  # if it is this object, it is farther from `map` with `filter.risk` at most
    hypotheses: Hypotheses
    object: int  # number of the object that this estimate is of
    objects: tuple[float, ...]  # (K,) probabilities of the known objects; the rest: none of them
    ess: float
    particles: int
    injected: int  # samples injected by this scan
    proposal: ProposalKind
    log_evidence: float  # log evidence of this scan; 0 where nothing was learned from it


@dataclass(frozen=True, slots=True)
class Place:
    """Where a belief has its object, up to the object's symmetry."""

    modes: tuple[Mode, ...]  # heaviest first; equivalent poses are one mode
    mean: Poses  # (3,)
    cov: Poses  # (3, 3) about the mean
    ess: float
    particles: int
    within: float  # probability that it is within `filter.within_m` of the heaviest mode
    radius_m: float  # it is farther with probability `filter.risk` at most


@dataclass(frozen=True, slots=True)
class Verdict:
    """The published object's place, and how sure it is."""

    place: Place
    here: float  # probability that it is this object, where the belief has it
    hypotheses: Hypotheses

    @property
    def p(self) -> float:
        return self.here * self.place.within


def placed(belief: Particles, metric: PoseMetric, config: FilterConfig) -> Place:
    """The place of an object that is where its belief has it."""
    weight, radius_m = belief.weight, MODE_RADIUS_M * metric.scale
    modes = metric.modes(belief.pose, weight, radius_m, MODES_MAX, MODE_CANDIDATES)
    mean, cov = metric.mean(belief.pose, weight, modes[0].pose)
    off = metric.distance(belief.pose, modes[0].pose)
    within = float(weight @ normal_cdf((config.within_m - off) / UNMODELLED_M))
    tail = float(np.sqrt(-np.log(config.risk)))  # of a Gaussian in the plane, in root-mean-squares
    spread_m = float(np.hypot(np.sqrt(weight @ off**2), UNMODELLED_M))
    radius_m = max(float(off.max()) + tail * UNMODELLED_M, tail * spread_m)
    ess = pf.effective_sample_size(belief)
    return Place(tuple(modes), mean, cov, ess, len(belief), within, radius_m)


def status(verdict: Verdict, contacts: int, *, blind: bool = False) -> Status:
    """The status after this number of contacts. `blind`: no taxel is live where the best pose
    expects contact."""
    if blind:
        return Status.BLIND
    if not contacts:
        return Status.SEARCHING
    if verdict.p >= SURE:
        return Status.CONVERGED
    stands, moved, other = verdict.hypotheses
    if stands < max(moved, other):
        return Status.INCONSISTENT
    weak = verdict.place.modes[0].weight < SEARCHING_WEIGHT
    return Status.SEARCHING if weak else Status.AMBIGUOUS
