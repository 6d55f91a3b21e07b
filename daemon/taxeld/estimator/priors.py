"""Priors of a belief as densities over poses: one that is given, and an earlier belief."""

from collections.abc import Sequence

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.model.scene import CONTINUOUS
from taxeld.model.symmetry import Mode, PoseMetric
from taxeld.prior import PosePrior

LEAST_SD = np.array([5e-4, 5e-4, 5e-3])  # m, m, rad: least sd of an earlier belief's mode
FLOOR = np.exp(-14.0)  # share of an earlier belief's peak everywhere: lets touches refute it


class PriorDensity:
    """A prior of one object that a user gives: a density in relation to a uniform one over the
    table.

    It may mean nothing, as a contact may, so touches refute it. It counts in a step of its own,
    with the contact that comes next: the object may have moved since the one before.
    """

    def __init__(
        self,
        pose: PosePrior,
        metric: PoseMetric,
        config: FilterConfig,
        log_touched: float,
        step: int,
    ) -> None:
        """`log_touched`: log volume of the poses at which the object is touched [m² rad]. `step`:
        number of the contact that it counts with."""
        self.pose, self.step, self._metric = pose, step, metric
        self._theta = pose.theta or 0.0
        is_round = metric.order == CONTINUOUS
        turns = 1.0 if is_round else 2.0 * np.pi / metric.order  # that differ [rad]
        # log volume of all poses on the table [m² rad]; of an object of revolution [m²]
        volume = 2.0 * float(np.log(2.0 * config.half_width_m)) + float(np.log(turns))
        self.log_untouched = volume - log_touched
        cov = np.reshape(pose.cov, (3, 3))
        # a yaw that is as wide as the turns that differ is none
        wide = pose.theta is None or np.sqrt(cov[2, 2]) > turns / 4.0
        self._has_yaw = not wide and not is_round
        self._centre = np.array([pose.x, pose.y])
        if pose.theta is not None:
            self._centre = metric.centres(np.array([pose.x, pose.y, pose.theta]))
        used = 3 if self._has_yaw else 2
        self._cov = cov[:used, :used]
        self._inverse = np.linalg.inv(self._cov)
        height = 0.5 * np.linalg.slogdet(self._inverse)[1] - 0.5 * used * np.log(2.0 * np.pi)
        self._height = float(height) + (volume - (0.0 if self._has_yaw else float(np.log(turns))))

    def log_density(self, poses: Poses) -> Floats:
        """Of poses (N, 3) → (N,), in relation to a uniform density over the table."""
        off, weight = self._metric.centres(poses) - self._centre, self.pose.weight
        if self._has_yaw:
            turn = self._metric.turn(poses[:, 2], np.asarray(self._theta))
            off = np.column_stack([off, turn])
        square = np.einsum("ni,ij,nj->n", off, self._inverse, off)
        return np.asarray(
            np.logaddexp(np.log(weight) + self._height - 0.5 * square, np.log1p(-weight))
        )

    def samples(self, n: int, rng: np.random.Generator) -> Poses:
        """(n, 3) poses, if it means this object."""
        off = rng.multivariate_normal(np.zeros(len(self._cov)), self._cov, n)
        theta = self._theta + off[:, 2] if self._has_yaw else rng.uniform(-np.pi, np.pi, n)
        return self._metric.placed(self._centre + off[:, :2], theta)


class BeliefPrior:
    """An earlier belief in few numbers, up to the object's symmetry: a Gaussian for each mode."""

    def __init__(
        self,
        metric: PoseMetric,
        poses: Poses,
        weight: Floats,
        modes: Sequence[Mode],
        log_volume: float = 0.0,
    ) -> None:
        """From a belief of poses (N, 3) with weights (N,), and its modes. Densities are relative to
        a uniform one over a volume of logarithm `log_volume`."""
        self._metric = metric
        self._modes = []
        for mode in modes:
            mean, cov = metric.mean(poses[mode.members], weight[mode.members], mode.pose)
            inverse = np.linalg.inv(cov + np.diag(LEAST_SD**2))
            height = float(np.log(mode.weight) + 0.5 * np.linalg.slogdet(inverse)[1])
            height += log_volume - 1.5 * float(np.log(2.0 * np.pi))
            self._modes.append((mean, inverse, height))
        self.ceiling = max(height for *_, height in self._modes)

    def log_density(self, poses: Poses) -> Floats:
        """Log-density of poses (N, 3) → (N,), up to a constant; about `ceiling` at most."""
        total = np.full(len(poses), FLOOR)
        for mean, inverse, height in self._modes:
            shift = self._metric.centres(poses) - self._metric.centres(mean)
            off = np.column_stack([shift, self._metric.turn(poses[:, 2], mean[2])])
            square = np.einsum("ni,ij,nj->n", off, inverse, off)
            total += np.exp(height - self.ceiling - 0.5 * square)
        return np.asarray(np.log(total) + self.ceiling)
