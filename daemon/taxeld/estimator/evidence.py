"""The evidence of a belief, and of what may be instead: which hypothesis the readings are for.

All of it is in relation to readings without the object (`anything`). Where the object is not what
is believed, nobody knows where it is, and contacts are explained one by one; so it is for something
else. Each hypothesis may hold since any step: before, it was this object.
"""

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

    def hypotheses(self, belief: Belief, runs: Runs) -> tuple[Hypotheses, float, float]:
        """→ the hypotheses; the probability that the object is where the belief has it; and the log
        evidence of this object, wherever it is."""
        found, stood = self.of(belief, runs), _stood(belief, runs)
        other: Floats = runs.begun.copy()
        other[0] += OTHER
        if (
            np.count_nonzero(runs.touched) < 2 and not runs.is_known
        ):  # a contact alone tells nothing
            here = 1.0 / (1.0 + float(np.exp(OTHER)))
            return Hypotheses(here, 0.0, 1.0 - here), here, max(found, 0.0)
        since = np.cumsum(runs.touched[::-1])[::-1]  # contacts since each step
        other += ALIKE * np.maximum(since - 1, 0)
        # since the newest step nobody knows where this object is
        log_weight = np.array([found, runs.begun[-1], *other[:-1]])
        weight = np.exp(log_weight - log_weight.max())
        here, gone, *others = (weight / weight.sum()).tolist()
        stands, log_z = here * stood, float(np.logaddexp(found, runs.begun[-1]))
        return Hypotheses(stands, here - stands + gone, sum(others)), here, log_z


def _stood(belief: Belief, runs: Runs) -> float:
    """The share of the belief whose run goes back to the first step."""
    each = runs.each(belief.remembered)
    each = np.exp(each - each.max(axis=1, keepdims=True))
    return min(float(belief.weight @ (each[:, 0] / each.sum(axis=1))), 1.0)
