"""An earlier belief in few numbers: a Gaussian for each of its modes."""

from collections.abc import Sequence

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model.symmetry import Mode, PoseMetric

LEAST_SD = np.array([5e-4, 5e-4, 5e-3])  # m, m, rad: least sd of a mode
FLOOR = np.exp(-14.0)  # share of the peak density: lets a prior be refuted


class Prior:
    """A density over poses, up to the object's symmetry."""

    def __init__(
        self, metric: PoseMetric, poses: Poses, weight: Floats, modes: Sequence[Mode]
    ) -> None:
        """From a belief of poses (N, 3) with weights (N,), and its modes."""
        self._metric = metric
        self._modes = []
        for mode in modes:
            mean, cov = metric.mean(poses[mode.members], weight[mode.members], mode.pose)
            inverse = np.linalg.inv(cov + np.diag(LEAST_SD**2))
            height = float(np.log(mode.weight) + 0.5 * np.linalg.slogdet(inverse)[1])
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
