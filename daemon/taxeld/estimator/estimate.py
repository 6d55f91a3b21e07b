"""The belief in short, and what it is worth."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator import particles as pf
from taxeld.estimator.particles import Belief
from taxeld.model.symmetry import Mode, PoseMetric

# lengths are for objects of a mean radius of 0.05 m; for others they are as much longer or shorter
MODE_RADIUS_M = 0.02  # of root-mean-square surface displacement
MODES_MAX = 5
MODE_CANDIDATES = 64
CONVERGED_WEIGHT = 0.9  # of the heaviest mode
CONVERGED_SD_M = 0.02  # and no more, however large the object
SEARCHING_WEIGHT = 0.2  # of the heaviest mode: below, no mode is worth its name


class Status(IntEnum):
    """What the estimate is worth."""

    STARTING = 0  # the idle baseline is being learned
    SEARCHING = 1  # nothing touched yet, or too little
    AMBIGUOUS = 2  # several modes explain the contacts
    CONVERGED = 3  # one mode, narrow, and a contact since has confirmed it
    BLIND = 4  # no live taxel, or none where contact is expected
    STALE = 5  # no fresh scan or sensor pose
    INCONSISTENT = 6  # no pose explains the readings: another object, moved, or a broken skin


class ProposalKind(IntEnum):
    """Which proposal served the last injection."""

    NONE = 0
    PROJECTION = 1
    DDPM = 2
    TABLE = 3
    MANIFOLD = 4
    DENSITY = 5


@dataclass(frozen=True, slots=True)
class Summary:
    """Where the belief lies, up to the object's symmetry."""

    modes: tuple[Mode, ...]  # heaviest first; equivalent poses are one mode
    mean: Poses  # (3,)
    cov: Poses  # (3, 3) about the mean
    ess: float
    particles: int
    is_narrow: bool  # one mode, and surface points within a small part of the object's size


@dataclass(frozen=True, slots=True)
class Estimate:
    """The belief in short; poses of the object in the world."""

    t: float  # of the scan
    status: Status
    contact: bool
    contacts: int  # begun since reset
    map: Poses  # (3,) mean of the heaviest mode
    mean: Poses  # (3,)
    cov: Poses  # (3, 3) about the mean, turns up to symmetry
    modes: tuple[Mode, ...]
    ess: float
    particles: int
    injected: int  # by this scan
    proposal: ProposalKind
    log_evidence: float  # of this scan, 0 where it was not learned from


def summarise(belief: Belief, metric: PoseMetric) -> Summary:
    weight = belief.weight
    radius_m = MODE_RADIUS_M * metric.scale
    modes = metric.modes(belief.pose, weight, radius_m, MODES_MAX, MODE_CANDIDATES)
    mean, cov = metric.mean(belief.pose, weight, modes[0].pose)
    spread = float(np.sqrt(cov[0, 0] + cov[1, 1] + metric.arm_m**2 * cov[2, 2]))
    ess = pf.effective_sample_size(belief)
    narrow = spread < CONVERGED_SD_M * min(metric.scale, 1.0)
    is_narrow = modes[0].weight >= CONVERGED_WEIGHT and narrow
    return Summary(tuple(modes), mean, cov, ess, len(belief), is_narrow)
