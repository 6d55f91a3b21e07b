"""The estimate: the belief in short, and its status."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from taxeld.arrays import Poses
from taxeld.estimator import particles as pf
from taxeld.estimator.particles import Belief
from taxeld.model.symmetry import Mode, PoseMetric

# Lengths are for an object of 0.05 m mean radius; they scale with the object.
MODE_RADIUS_M = 0.02  # root-mean-square displacement of surface points
MODES_MAX = 5
MODE_CANDIDATES = 32
SURE = 0.99  # least p of a converged estimate
SEARCHING_WEIGHT = 0.2  # least weight of the heaviest mode: a lighter one is not worth reporting


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
class Summary:
    """Place and spread of the belief, up to the object's symmetry."""

    modes: tuple[Mode, ...]  # heaviest first; equivalent poses are one mode
    mean: Poses  # (3,)
    cov: Poses  # (3, 3) about the mean
    ess: float
    particles: int


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


def summarise(belief: Belief, metric: PoseMetric) -> Summary:
    weight = belief.weight
    radius_m = MODE_RADIUS_M * metric.scale
    modes = metric.modes(belief.pose, weight, radius_m, MODES_MAX, MODE_CANDIDATES)
    mean, cov = metric.mean(belief.pose, weight, modes[0].pose)
    return Summary(tuple(modes), mean, cov, pf.effective_sample_size(belief), len(belief))
