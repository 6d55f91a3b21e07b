"""The evidence of a belief, and of what may be instead: which hypothesis the readings are for.

All of it is in relation to readings without the object (`anything`). Where the object is not what
is believed, nobody knows where it is, and contacts are explained one by one; so it is for something
else. Each hypothesis may hold since any step: before, it was this object.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Floats
from taxeld.estimator import particles as pf
from taxeld.estimator.estimate import Hypotheses
from taxeld.estimator.particles import Belief
from taxeld.estimator.runs import Runs
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import CONTINUOUS
from taxeld.model.symmetry import PoseMetric

FINE = np.array([0.004, 0.004, 0.06])  # m, m, rad: cells that measure the room that a belief takes
OTHER = -1.0  # log odds of another object before anything is felt
ALIKE = 3.0  # nats a contact after its first, by which another object explains itself better


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

    def shifted(self, best: "ObjectEvidence", before: float) -> "ObjectEvidence":
        """This evidence as long as the newest contact is not weighed for this object: the best
        object's log evidence was `before` then."""
        by = best.log_z - before
        return best._replace(found=self.found + by, gone=self.gone + by, other=np.empty(0))


UNTOUCHED = ObjectEvidence(0.0, -np.inf, np.empty(0), 1.0)  # nothing speaks against the object


class ModelEvidence:
    """Of beliefs about one object on one skin."""

    def __init__(self, model: ObservationModel, metric: PoseMetric) -> None:
        scene, self._metric = model.scene, metric
        self._cell = FINE * [metric.scale, metric.scale, 1.0]
        # an object is touched where the link's axis is beside its outline, at any yaw
        outline_m = float(np.linalg.norm(np.diff(scene.outline, axis=0), axis=1).sum())
        area = (outline_m + 2.0 * np.pi * model.layout.radius_m) * model.depth_max_m
        turns = 2.0 * np.pi / max(scene.symmetry, 1)
        cells = area / self._cell[:2].prod() * turns / self._cell[2]
        if scene.symmetry == CONTINUOUS:
            cells = area / self._cell[:2].prod()
        self._log_cells = float(np.log(cells))
        self.log_volume = self._log_cells + float(np.log(self._cell.prod()))

    def of(self, belief: Belief, runs: Runs) -> float:
        """log ∫ ∏ p(z_k | q) dq over all poses that touch: the mean logarithm of the integrand and
        the belief's entropy, measured by the cells that it occupies."""
        support = float(belief.weight @ runs.support(belief.remembered))
        cells = pf.occupied(self._metric.reduced(belief.pose), self._cell)
        return support + float(np.log(cells)) - self._log_cells

    def weighed(self, belief: Belief, runs: Runs) -> ObjectEvidence:
        """The evidence of a belief, and of what may be instead of it."""
        found, stood = self.of(belief, runs), _stood(belief, runs)
        other: Floats = runs.begun.copy()
        other[0] += OTHER
        since = np.cumsum(runs.touched[::-1])[::-1]  # contacts since each step
        other += ALIKE * np.maximum(since - 1, 0)
        if np.count_nonzero(runs.touched) < 2 and not runs.is_known:
            return ObjectEvidence(found, -np.inf, np.array([OTHER]), stood, is_first=True)
        return ObjectEvidence(found, float(runs.begun[-1]), other[:-1], stood)


class Odds(NamedTuple):
    """Probabilities of what was touched, with K objects that it may be."""

    hypotheses: Hypotheses
    here: Floats  # (K,) it is this object, where its belief has it
    objects: Floats  # (K,) it is this object, wherever it is
    log_z: float  # log evidence of all that may be, in relation to readings without an object


def odds(each: Sequence[ObjectEvidence]) -> Odds:
    """Weigh K objects, equally likely before anything is felt, and something else."""
    found, gone, stood = np.array([(w.found, w.gone, w.stood) for w in each]).T
    apart = np.log(len(each))
    other = [w.other for w in each if len(w.other)]
    # something else since the first step has nothing to do with any object, so it counts once
    first = max((float(one[0]) for one in other), default=-np.inf)
    if any(w.is_first for w in each):
        first += _log_sum(found) - apart
    later = np.concatenate([one[1:] for one in other]) if other else np.empty(0)
    log_weight = np.concatenate([found - apart, gone - apart, [first], later - apart])
    log_z = _log_sum(log_weight)
    weight = np.exp(log_weight - log_z)
    here, away = weight[: len(each)], weight[len(each) : 2 * len(each)]
    stands = float(here @ stood)
    moved = float(here.sum() - stands + away.sum())
    left = Hypotheses(stands, moved, float(weight[2 * len(each) :].sum()))
    return Odds(left, here, here + away, log_z)


def _log_sum(values: Floats) -> float:
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).sum()))


def _stood(belief: Belief, runs: Runs) -> float:
    """The share of the belief whose run goes back to the first step."""
    each = runs.each(belief.remembered)
    each = np.exp(each - each.max(axis=1, keepdims=True))
    return min(float(belief.weight @ (each[:, 0] / each.sum(axis=1))), 1.0)
