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
class Verdict:
    """The belief in short, and how sure it is."""

    summary: Summary
    p: float
    radius_m: float
    hypotheses: Hypotheses


def judge(
    belief: Belief, metric: PoseMetric, config: FilterConfig, hypotheses: Hypotheses, here: float
) -> Verdict:
    """`here`: probability that the belief has the object at all: it is this object, and has not
    just moved to nobody knows where."""
    summary = summarise(belief, metric)
    off = metric.distance(belief.pose, summary.modes[0].pose)
    weight = belief.weight
    within = normal_cdf((config.within_m - off) / UNMODELLED_M)
    tail = float(np.sqrt(-np.log(config.risk)))  # of a Gaussian in the plane, in root-mean-squares
    spread_m = np.hypot(np.sqrt(weight @ off**2), UNMODELLED_M)
    radius_m = max(float(off.max()) + tail * UNMODELLED_M, tail * float(spread_m))
    p = here * float(weight @ within)
    return Verdict(summary, p, radius_m, hypotheses)


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
    weak = verdict.summary.modes[0].weight < SEARCHING_WEIGHT
    return Status.SEARCHING if weak else Status.AMBIGUOUS
