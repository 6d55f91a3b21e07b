"""A filter that is told what the object rests on: the limit of what can be known of a push.

Its particles are pushed as the world pushes the object, by its ground and with its friction, which
no filter knows.
"""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.push import Push
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric
from taxeld_training.filters.ground import Ground
from taxeld_training.filters.pusher import SETTLING

SPREAD = 0.2  # sd of a push, as a share of it: what is left where all of the ground is known
CLOSE_M = 1e-9  # less is no overlap


def told(ground: Ground) -> Push:
    """As `estimator.push.push`, whatever the particles assume."""

    def push(
        model: ObservationModel, metric: PoseMetric, poses: Poses, assumed: Floats, before: Poses,
        after: Poses, depth_m: float, rng: np.random.Generator,
    ) -> tuple[Poses, Floats]:  # fmt: skip
        del assumed
        poses, pushed = _gave_way(model, ground, poses, before, after, depth_m)
        noise = SPREAD * pushed[:, None] * rng.standard_normal((len(poses), 3))
        centre = metric.centres(poses) + noise[:, :2]
        return metric.placed(centre, poses[:, 2] + noise[:, 2] / model.scene.mean_radius), pushed

    return push


def _gave_way(
    model: ObservationModel, ground: Ground, poses: Poses, before: Poses, after: Poses,
    depth_m: float,
) -> tuple[Poses, Floats]:  # fmt: skip
    """Poses (N, 3) once the sensor has moved from one pose (3,) to another and presses `depth_m`
    deep, and how far each was pushed (N,), no farther than the sensor went."""
    pushed, advance = np.zeros(len(poses)), np.full(len(poses), np.inf)
    moved = np.tile(after[:2] - before[:2], (len(poses), 1))
    for _ in range(SETTLING):
        ax, ay = contacts.axis_in_object(se2.compose(se2.inverse(after), poses))
        clearance, gx, gy = model.scene.clearance(ax, ay)
        inwards = -np.column_stack([gx, gy])
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        seen = np.column_stack(
            [c * moved[:, 0] + s * moved[:, 1], c * moved[:, 1] - s * moved[:, 0]]
        )
        along = np.sum(seen * inwards, axis=1)
        if moved.any():
            advance = np.maximum(along, 0.0)
        gives = np.clip(model.layout.radius_m - clearance - depth_m, 0.0, advance - pushed)
        some = gives > CLOSE_M
        if not some.any():
            break
        pushed += gives
        wanted = gives[:, None] * inwards + seen - along[:, None] * inwards
        contact = np.column_stack([ax, ay]) + clearance[:, None] * inwards
        slide = np.zeros((len(poses), 3))
        slide[some] = ground.slide(contact[some], wanted[some], inwards[some])
        poses = se2.compose(poses, slide)
        moved = np.zeros_like(moved)
    return poses, pushed
