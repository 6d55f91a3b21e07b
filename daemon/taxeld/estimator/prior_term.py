"""A prior as a term of a belief: a density in relation to a uniform one over the table.

It may mean nothing, as a contact may, so touches refute it. It counts in a step of its own, with
the contact that comes next: the object may have moved since the one before.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.model.scene import CONTINUOUS
from taxeld.model.symmetry import PoseMetric
from taxeld.prior import PosePrior


@dataclass(frozen=True, slots=True)
class TableTop:
    """Where an object may be, and how it turns."""

    metric: PoseMetric
    centre_m: tuple[float, float]
    half_width_m: float
    log_touched: float  # log volume of the poses at which it is touched [m² rad]

    @classmethod
    def of(cls, metric: PoseMetric, config: FilterConfig, log_touched: float) -> "TableTop":
        return cls(metric, config.centre_m, config.half_width_m, log_touched)

    @property
    def log_volume(self) -> float:
        """Log volume of all poses [m² rad]; of an object of revolution [m²]."""
        return 2.0 * float(np.log(2.0 * self.half_width_m)) + float(np.log(self.turns))

    @property
    def turns(self) -> float:
        """The turns that differ [rad]; 1 for an object of revolution."""
        order = self.metric.order
        return 1.0 if order == CONTINUOUS else 2.0 * np.pi / order


class PriorTerm:
    """A prior for one object, and the step that it counts in."""

    def __init__(self, pose: PosePrior, table: TableTop, step: int) -> None:
        self.pose, self.table, self.step = pose, table, step
        metric, self._theta = table.metric, pose.theta or 0.0
        cov = np.reshape(pose.cov, (3, 3))
        # a yaw that is as wide as the turns that differ is none
        wide = pose.theta is None or np.sqrt(cov[2, 2]) > table.turns / 4.0
        self._has_yaw = not wide and metric.order != CONTINUOUS
        self._centre = np.array([pose.x, pose.y])
        if pose.theta is not None:
            self._centre = metric.centres(np.array([pose.x, pose.y, pose.theta]))
        used = 3 if self._has_yaw else 2
        self._cov = cov[:used, :used]
        self._inverse = np.linalg.inv(self._cov)
        volume = table.log_volume - (0.0 if self._has_yaw else float(np.log(table.turns)))
        height = 0.5 * np.linalg.slogdet(self._inverse)[1] - 0.5 * used * np.log(2.0 * np.pi)
        self._height = float(height) + volume

    def _off(self, poses: Poses) -> Floats:
        """(N, 2 or 3) from the prior's mean to poses (N, 3)."""
        metric = self.table.metric
        shift = metric.centres(poses) - self._centre
        if not self._has_yaw:
            return np.asarray(shift)
        return np.column_stack([shift, metric.turn(poses[:, 2], np.asarray(self._theta))])

    def log_density(self, poses: Poses) -> Floats:
        """Of poses (N, 3) → (N,), in relation to a uniform density over the table."""
        off, weight = self._off(poses), self.pose.weight
        square = np.einsum("ni,ij,nj->n", off, self._inverse, off)
        return np.asarray(
            np.logaddexp(np.log(weight) + self._height - 0.5 * square, np.log1p(-weight))
        )

    def samples(self, n: int, rng: np.random.Generator) -> Poses:
        """(n, 3) poses, if it means this object."""
        metric = self.table.metric
        off = rng.multivariate_normal(np.zeros(len(self._cov)), self._cov, n)
        theta = self._theta + off[:, 2] if self._has_yaw else rng.uniform(-np.pi, np.pi, n)
        return metric.placed(self._centre + off[:, :2], theta)
