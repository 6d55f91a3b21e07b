"""A filter that is told what the object rests on: the limit of what can be known of a push.

Its particles are pushed as the world pushes the object, by its ground and with its friction, which
no filter knows.
"""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.push import Push
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric
from taxeld_training.filters.ground import Ground
from taxeld_training.filters.pusher import gave_way

SPREAD = 0.2  # sd of a push, as a share of it: what is left where all of the ground is known


def told(ground: Ground) -> Push:
    """As `estimator.push.push`, whatever the particles assume."""

    def push(
        model: ObservationModel, metric: PoseMetric, poses: Poses, assumed: Floats, before: Poses,
        after: Poses, depth_m: float, rng: np.random.Generator,
    ) -> tuple[Poses, Floats]:  # fmt: skip
        del assumed
        poses, pushed = gave_way(model, ground, poses, before, after, depth_m, limited=True)
        noise = SPREAD * pushed[:, None] * rng.standard_normal((len(poses), 3))
        centre = metric.centres(poses) + noise[:, :2]
        return metric.placed(centre, poses[:, 2] + noise[:, 2] / model.scene.mean_radius), pushed

    return push
