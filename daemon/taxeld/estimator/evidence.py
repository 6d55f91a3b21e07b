"""What is evidence for which hypothesis: the object stands, it has moved, or it is something else.

The object may have moved between two contacts, so the newest pose explains the contacts from some
*first* one on, its run. The belief's target is the sum over all first contacts; the evidence of all
before one is a number (Bayesian change points, Adams & MacKay 2007). A contact may also mean
nothing.

All of it is in relation to readings without the object (`background`). If another object was
touched, its pose is unknown; each contact is then scored alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats
from taxeld.estimator import particles as pf
from taxeld.estimator.estimate import Hypotheses
from taxeld.estimator.particles import Explained, Particles
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import CONTINUOUS
from taxeld.model.symmetry import PoseMetric

HAZARD = 2e-3  # probability that the object moved between two contacts
MOVED = 0.05  # probability that the object was moved while no daemon ran
SWAPPED = float(np.log(0.1))  # log share of the moves in which another known object took its place
MEANINGLESS = 1e-3  # probability that a contact has nothing to do with the object
LEAST = float(np.log(MEANINGLESS))
FINE = np.array([0.004, 0.004, 0.06])  # m, m, rad: cells that measure the room that a belief takes
OTHER = -1.0  # log odds of another object before anything is felt
ALIKE = 3.0  # nats a contact after its first, by which another object explains itself better


@dataclass(frozen=True, slots=True)
class Runs:
    """K remembered scans in R steps: a contact, or the silence since the contact before."""

    step: NDArray[np.intp]  # (R,) numbers of the contacts
    shares: Floats  # (K, 2 R) a scan's share in its step's contact, then in its step's silence
    of_priors: Floats  # (P, 2 R) 1 where a prior counts
    background: Floats  # (2 R,) log-likelihoods of the scans without this object
    touched: Bools  # (R,) whether a step has a contact
    begun: Floats  # (R,) log prior of a run from each step on, with the evidence before it
    open: Floats  # (R,) the same; −inf where silence alone would tell of a new pose
    is_known: bool = False  # whether an earlier belief says where the object was before

    def each(self, explained: Explained) -> Floats:
        """Log-densities (N, R) of poses by run."""
        log_p = explained.scans @ self.shares + explained.priors @ self.of_priors - self.background
        least, steps = np.where(self.touched, LEAST, -np.inf), len(self.begun)
        met = np.logaddexp(log_p[:, :steps], least) + log_p[:, steps:]
        return np.asarray(met[:, ::-1].cumsum(axis=1)[:, ::-1] + self.open)

    def support(self, explained: Explained) -> Floats:
        """Log-density (N,) of poses, up to the uniform prior's."""
        if not len(self.begun):  # nothing is remembered but an earlier belief, if that
            return np.asarray(explained.priors.sum(axis=1))
        each = self.each(explained)
        top = each.max(axis=1)
        return np.asarray(top + np.log(np.exp(each - top[:, None]).sum(axis=1)))


def inherited(particles: Particles, before: Runs, fewer: Runs, explained: Explained) -> Floats:
    """Nats (R,) by which each run of `fewer` scans must gain, so that it keeps its share of
    particles of all scans. A run whose first contact is forgotten hands its share to the next one.
    `explained`: by the fewer scans."""
    known = particles.log_weight - before.support(particles.explained)
    held = np.logaddexp.reduce(before.each(particles.explained) + known[:, None])
    left = np.logaddexp.reduce(fewer.each(explained) + known[:, None])
    heirs = np.flatnonzero(np.isfinite(left))
    shares, heir = np.full(len(heirs), -np.inf), np.searchsorted(fewer.step[heirs], before.step)
    np.logaddexp.at(shares, np.minimum(heir, len(heirs) - 1), held)
    # a step without a contact yet, where no run can begin, gains as the run before it
    own = np.searchsorted(heirs, np.arange(len(left)), side="right") - 1
    return np.asarray((shares - left[heirs])[own])


class ObjectEvidence(NamedTuple):
    """Log evidence of one object, in relation to readings without it."""

    found: float  # it is where the belief has it
    gone: float  # it has moved since the newest step, and nobody knows where to
    other: Floats  # (R − 1,) since each step but the newest it is something else
    stood: float  # share of `found` in which it has stood since the first step
    is_first: bool = False  # a contact alone does not tell this object from another

    @property
    def log_z(self) -> float:
        """Log evidence of this object, wherever it is."""
        return max(self.found, 0.0) if self.is_first else float(np.logaddexp(self.found, self.gone))

    def shifted(self, log_z: float) -> "ObjectEvidence":
        """The same with this `log_z`, as long as newer contacts are not weighed for the object."""
        by = log_z - self.log_z
        return self._replace(found=self.found + by, gone=self.gone + by, other=np.empty(0))


UNTOUCHED = ObjectEvidence(0.0, -np.inf, np.empty(0), 1.0)  # nothing speaks against the object


class ModelEvidence:
    """Of particles of one object on one skin."""

    def __init__(self, model: ObservationModel, metric: PoseMetric) -> None:
        scene, self._metric = model.scene, metric
        self._cell = FINE * [metric.scale, metric.scale, 1.0]
        # an object is touched where the link's axis is beside its outline, at any yaw
        outline_m = float(np.linalg.norm(np.diff(scene.outline, axis=0), axis=1).sum())
        area = (outline_m + 2.0 * np.pi * model.layout.radius_m) * model.depth_max_m
        cells = area / self._cell[:2].prod()
        if scene.symmetry != CONTINUOUS:
            cells = cells * (2.0 * np.pi / max(scene.symmetry, 1)) / self._cell[2]
        self._log_cells = float(np.log(cells))
        self.log_volume = self._log_cells + float(np.log(self._cell.prod()))

    def of(self, particles: Particles, runs: Runs) -> float:
        """log ∫ ∏ p(z_k | q) dq over all poses that touch: the mean logarithm of the integrand and
        the particles' entropy, measured by the cells that they occupy."""
        support = float(particles.weight @ runs.support(particles.explained))
        cells = pf.occupied(self._metric.reduced(particles.pose), self._cell)
        return support + float(np.log(cells)) - self._log_cells

    def weighed(self, particles: Particles, runs: Runs) -> ObjectEvidence:
        """The evidence of particles, and of what may be instead of them."""
        found = self.of(particles, runs)
        each = runs.each(particles.explained)
        each = np.exp(each - each.max(axis=1, keepdims=True))
        stood = min(float(particles.weight @ (each[:, 0] / each.sum(axis=1))), 1.0)
        if np.count_nonzero(runs.touched) < 2 and not runs.is_known:
            return ObjectEvidence(found, -np.inf, np.array([OTHER]), stood, is_first=True)
        other: Floats = runs.begun.copy()
        other[0] += OTHER
        since = np.cumsum(runs.touched[::-1])[::-1]  # contacts since each step
        other += ALIKE * np.maximum(since - 1, 0)
        return ObjectEvidence(found, float(runs.begun[-1]), other[:-1], stood)


class Odds(NamedTuple):
    """Probabilities of what was touched, with K objects that it may be."""

    hypotheses: Hypotheses
    here: Floats  # (K,) it is this object, where its belief has it
    objects: Floats  # (K,) it is this object, wherever it is


def odds(each: Sequence[ObjectEvidence]) -> Odds:
    """Weigh K objects, equally likely before anything is felt, and something else."""
    found, gone, stood = np.array([(w.found, w.gone, w.stood) for w in each]).T
    apart = np.log(len(each))
    other = [w.other for w in each if len(w.other)]
    # something else since the first step has nothing to do with any object, so it counts once
    first = max((float(one[0]) for one in other), default=-np.inf)
    if any(w.is_first for w in each):
        first += pf.log_sum_exp(found) - apart
    later = np.concatenate([one[1:] for one in other]) if other else np.empty(0)
    log_weight = np.concatenate([found - apart, gone - apart, [first], later - apart])
    weight = np.exp(log_weight - pf.log_sum_exp(log_weight))
    here, away = weight[: len(each)], weight[len(each) : 2 * len(each)]
    stands = float(here @ stood)
    moved = float(here.sum() - stands + away.sum())
    left = Hypotheses(stands, moved, float(weight[2 * len(each) :].sum()))
    return Odds(left, here, here + away)
