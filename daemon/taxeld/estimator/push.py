"""Where a pushed object goes: a quasi-static prior from sensor motion and contact normal.

An object on a table moves only as far as it is pushed. The load that the sensor puts on it and its
slow motion are related by the friction's limit surface, taken as an ellipsoid: a force f at a point
r from the centre of friction moves the object by f and turns it by (r × f) / c² (Lynch, Maekawa &
Tanie 1992). Whether the skin slips or sticks is not known: each particle draws its share of both.
"""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric

LIMIT = 0.6  # of the outline's mean radius: the c of an even load on a table
SPREAD = 1.0  # sd of how far and where it goes, as a share of how far it was pushed


def push(
    model: ObservationModel, metric: PoseMetric, poses: Poses, before: Poses, after: Poses,
    depth_m: float, rng: np.random.Generator,
) -> tuple[Poses, Floats]:  # fmt: skip
    """Object poses (N, 3) in the world after the sensor has gone from one pose (3,) to another
    while a contact was read `depth_m` deep; → poses, and how far each was pushed (N,) [m].

    Where the sensor would press deeper than was read, the object has given way; nothing is pulled.
    """
    n = len(poses)
    radius_m = model.layout.radius_m
    ax, ay = contacts.axis_in_object(se2.compose(se2.inverse(after), poses))
    clearance, gx, gy = model.scene.clearance(ax, ay)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    inwards = -np.column_stack([c * gx - s * gy, s * gx + c * gy])  # into the object, in the world
    moved = after[:2] - before[:2]
    advance = np.maximum(inwards @ moved, 0.0)
    pushed = np.clip(radius_m - clearance - depth_m, 0.0, advance)
    arm = after[:2] + clearance[:, None] * inwards - metric.centres(poses)
    limit_m = LIMIT * model.scene.mean_radius
    stick = rng.random((n, 1)) * (pushed / np.maximum(advance, 1e-9))[:, None]
    wanted = pushed[:, None] * inwards + stick * (moved - advance[:, None] * inwards)
    across = np.column_stack([-arm[:, 1], arm[:, 0]]) / limit_m
    force = (
        wanted
        - across * (np.sum(across * wanted, axis=1) / (1.0 + np.sum(across**2, axis=1)))[:, None]
    )  # (I + a aᵀ)⁻¹ wanted: the contact moves as wanted
    noise = SPREAD * pushed[:, None] * rng.standard_normal((n, 3))
    turn = (np.sum(across * force, axis=1) + noise[:, 2]) / limit_m
    centre = metric.centres(poses) + force + noise[:, :2]
    return metric.placed(centre, poses[:, 2] + turn), pushed
