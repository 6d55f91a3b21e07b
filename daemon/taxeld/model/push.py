"""Where a pushed object goes: a quasi-static model from sensor motion and contact normal.

An object on a table moves only as far as it is pushed. The sensor's load on it and its slow motion
are related by the friction's limit surface, taken as an ellipsoid: a force f at a point r from the
centre of friction moves that centre by f and turns the object by (r × f) / c² (Lynch, Maekawa &
Tanie 1992). The contact sticks while this force is inside Coulomb's cone, else it slips along the
cone's edge.

The centre of friction, c and the friction differ between objects and are not known. Each particle
keeps assumptions of its own, so the particles survive whose object went where it was felt.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric

# Assumptions: centre of friction (x, y) from the middle in the object's frame, c (all three in mean
# radii of the outline), and the friction of skin on object.
MEAN = np.array([0.0, 0.0, 0.6, 0.4])
SD = np.array([0.2, 0.2, 0.08, 0.15])
LEAST = np.array([-np.inf, -np.inf, 0.3, 0.05])
CHANGE = 0.25  # sd by which an assumption changes over a push of STRIDE
STRIDE = 0.05  # mean radii
SPREAD = 0.25  # sd of the motion, as a share of the pushed length

Push: TypeAlias = Callable[
    [ObservationModel, PoseMetric, Poses, Floats, Poses, Poses, float, np.random.Generator],
    tuple[Poses, Floats],
]


def assumed(n: int, rng: np.random.Generator) -> Floats:
    """(n, 4) assumptions of n particles about the ground, in SD from MEAN."""
    return np.asarray(rng.standard_normal((n, len(MEAN))))


def changed(ground: Floats, strides: float, rng: np.random.Generator) -> Floats:
    """Assumptions `ground` (N, 4) after a push of `strides` strides: slightly changed, so that
    copies separate. Without evidence their distribution stays that of `assumed`."""
    step = min(CHANGE * np.sqrt(strides), 1.0)
    return np.asarray(np.sqrt(1.0 - step**2) * ground + step * assumed(len(ground), rng))


def push(
    model: ObservationModel,
    metric: PoseMetric,
    poses: Poses,
    ground: Floats,
    before: Poses,
    after: Poses,
    depth_m: float,
    rng: np.random.Generator,
) -> tuple[Poses, Floats]:
    """Object poses (N, 3) in the world after the sensor moved from pose `before` (3,) to `after`
    (3,) while a contact was read `depth_m` deep. `ground` (N, 4) is as from `assumed`. → poses (N,
    3), and how far each was pushed (N,) [m].

    Where the sensor would press deeper than it read, the object has given way; nothing is pulled.
    """
    length_m = model.scene.mean_radius
    ground = np.maximum(MEAN + SD * ground, LEAST)
    offset, limit_m, friction = length_m * ground[:, :2], length_m * ground[:, 2], ground[:, 3]
    ax, ay = contacts.axis_in_object(se2.compose(se2.inverse(after), poses))
    clearance, gx, gy = model.scene.clearance(ax, ay)
    inwards = -_turned(np.column_stack([gx, gy]), poses[:, 2])  # unit vectors into the object
    moved = after[:2] - before[:2]
    advance = np.maximum(inwards @ moved, 0.0)
    pushed = np.clip(model.layout.radius_m - clearance - depth_m, 0.0, advance)
    share = (pushed / np.maximum(advance, 1e-9))[:, None]
    wanted = pushed[:, None] * inwards + share * (moved - advance[:, None] * inwards)
    aside = _turned(offset, poses[:, 2])  # centre of friction from the middle [m]
    arm = after[:2] + clearance[:, None] * inwards - metric.centres(poses) - aside
    lever = np.column_stack([-arm[:, 1], arm[:, 0]]) / limit_m[:, None]
    force = _force(lever, wanted, inwards, friction)
    noise = SPREAD * pushed[:, None] * assumed(len(poses), rng)[:, :3]
    turn = (_dot(lever, force) + noise[:, 2]) / limit_m
    centre = metric.centres(poses) + force + aside - _turned(aside, turn) + noise[:, :2]
    return metric.placed(centre, poses[:, 2] + turn), pushed


def _force(lever: Floats, wanted: Floats, inwards: Floats, friction: Floats) -> Floats:
    """(N, 2) the force f whose motion of the contact, f + lever (lever · f), is `wanted` (N, 2).
    Where f lies outside the friction cone about `inwards` (N, 2), the force on the cone's edge that
    moves the contact as far along the normal as wanted."""
    force = wanted - lever * (_dot(lever, wanted) / (1.0 + _dot(lever, lever)))[:, None]
    normal = _dot(force, inwards)
    sideways = force - normal[:, None] * inwards
    size = np.linalg.norm(sideways, axis=1)
    edge = inwards + (friction / np.maximum(size, 1e-12))[:, None] * sideways
    speed = _dot(inwards, edge) + _dot(inwards, lever) * _dot(lever, edge)
    slips = (size > friction * normal) & (speed > 0.0)
    force[slips] = (edge * (_dot(wanted, inwards) / np.where(slips, speed, 1.0))[:, None])[slips]
    return np.asarray(force)


def _dot(a: Floats, b: Floats) -> Floats:
    """Dot products (N,) of vectors (N, 2) and (N, 2)."""
    return np.asarray(np.sum(a * b, axis=1))


def _turned(vectors: Floats, angle: Floats) -> Floats:
    """Vectors (N, 2) turned by angles (N,)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y])
