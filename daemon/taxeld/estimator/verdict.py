"""The verdict: what a belief says of the object, in probabilities, and the status they make."""

from dataclasses import dataclass

import numpy as np

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import SEARCHING_WEIGHT, SURE, Hypotheses, Status, Summary, summarise
from taxeld.estimator.particles import Belief
from taxeld.model.noise import normal_cdf
from taxeld.model.symmetry import PoseMetric

UNMODELLED_M = 0.002  # sd of the pose beside the belief's own: robot, foam and shape err unmodelled


@dataclass(frozen=True, slots=True)
class Place:
    """Where a belief has its object."""

    summary: Summary
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


def placed(belief: Belief, metric: PoseMetric, config: FilterConfig) -> Place:
    """The place of an object that is where its belief has it."""
    summary = summarise(belief, metric)
    off = metric.distance(belief.pose, summary.modes[0].pose)
    weight = belief.weight
    within = normal_cdf((config.within_m - off) / UNMODELLED_M)
    tail = float(np.sqrt(-np.log(config.risk)))  # of a Gaussian in the plane, in root-mean-squares
    spread_m = np.hypot(np.sqrt(weight @ off**2), UNMODELLED_M)
    radius_m = max(float(off.max()) + tail * UNMODELLED_M, tail * float(spread_m))
    return Place(summary, float(weight @ within), radius_m)


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
    weak = verdict.place.summary.modes[0].weight < SEARCHING_WEIGHT
    return Status.SEARCHING if weak else Status.AMBIGUOUS
