"""Where a pushed object goes: a quasi-static model from sensor motion and contact normal.

An object on a table moves only as far as it is pushed. The load that the sensor puts on it and its
slow motion are related by the friction's limit surface, taken as an ellipsoid: a force f at a point
r from the centre of friction moves that centre by f and turns the object by (r × f) / c² (Lynch,
Maekawa & Tanie 1992). The contact sticks while the force that this takes is inside Coulomb's cone,
else it slips along the cone's edge. Centre, c and friction are the object's own, and not known:
each particle assumes some, and keeps them, so that those remain whose object went where it is felt.
"""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric

MEAN = np.array([0.0, 0.0, 0.6, 0.4])  # of what is assumed: centre (x, y) and c, in mean radii
SD = np.array([0.2, 0.2, 0.08, 0.15])  # of the outline, from its middle; friction of the skin
LEAST = np.array([-np.inf, -np.inf, 0.3, 0.05])
CHANGE = 0.15  # of what is assumed, in sd, for a push as far as 1/20 of the mean radius
SPREAD = 0.25  # sd of how far and where it goes, as a share of how far it was pushed


def assumed(n: int, rng: np.random.Generator) -> Floats:
    """(n, 4) what so many particles assume, in standard deviations: centre of friction (x, y), c,
    friction of the skin on the object."""
    return np.asarray(rng.standard_normal((n, len(MEAN))))


def push(
    model: ObservationModel, metric: PoseMetric, poses: Poses, ground: Floats, before: Poses,
    after: Poses, depth_m: float, rng: np.random.Generator,
) -> tuple[Poses, Floats]:  # fmt: skip
    """Object poses (N, 3) in the world after the sensor has gone from one pose (3,) to another
    while a contact was read `depth_m` deep, on `ground` as `assumed` (N, 4); → poses, and how far
    each was pushed (N,) [m].

    Where the sensor would press deeper than was read, the object has given way; nothing is pulled.
    """
    n = len(poses)
    ground = np.maximum(MEAN + SD * ground, LEAST)
    radius_m, length_m = model.layout.radius_m, model.scene.mean_radius
    ax, ay = contacts.axis_in_object(se2.compose(se2.inverse(after), poses))
    clearance, gx, gy = model.scene.clearance(ax, ay)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    inwards = -np.column_stack([c * gx - s * gy, s * gx + c * gy])  # into the object, in the world
    moved = after[:2] - before[:2]
    advance = np.maximum(inwards @ moved, 0.0)
    pushed = np.clip(radius_m - clearance - depth_m, 0.0, advance)
    share = pushed / np.maximum(advance, 1e-9)
    wanted = pushed[:, None] * inwards + share[:, None] * (moved - advance[:, None] * inwards)
    x, y = length_m * ground[:, 0], length_m * ground[:, 1]
    middle = metric.centres(poses)
    rests = middle + np.column_stack([c * x - s * y, s * x + c * y])
    arm = after[:2] + clearance[:, None] * inwards - rests
    limit_m = length_m * ground[:, 2]
    across = np.column_stack([-arm[:, 1], arm[:, 0]]) / limit_m[:, None]
    force = _held(across, wanted)
    normal = np.sum(force * inwards, axis=1)
    aside = force - normal[:, None] * inwards
    size = np.linalg.norm(aside, axis=1)
    edge = inwards + (ground[:, 3] / np.maximum(size, 1e-12))[:, None] * aside
    speed = np.sum(inwards * (edge + across * np.sum(across * edge, axis=1)[:, None]), axis=1)
    slips = (size > ground[:, 3] * normal) & (speed > 0.0)
    force[slips] = edge[slips] * (pushed[slips] / speed[slips])[:, None]
    noise = SPREAD * pushed[:, None] * rng.standard_normal((n, 3))
    turn = (np.sum(across * force, axis=1) + noise[:, 2]) / limit_m
    # the centre of friction goes with the force, and the middle turns about it
    ct, st = np.cos(turn) - 1.0, np.sin(turn)
    off = middle - rests
    swung = np.column_stack([ct * off[:, 0] - st * off[:, 1], st * off[:, 0] + ct * off[:, 1]])
    centre = middle + force + swung + noise[:, :2]
    return metric.placed(centre, poses[:, 2] + turn), pushed


def changed(ground: Floats, share: float, rng: np.random.Generator) -> Floats:
    """What is assumed (N, 4), a little other, so that copies part; without evidence it stays
    distributed as `assumed` has it."""
    step = min(CHANGE * np.sqrt(share), 1.0)
    return np.asarray(np.sqrt(1 - step**2) * ground + step * rng.standard_normal(ground.shape))


def _held(across: Floats, wanted: Floats) -> Floats:
    """(I + a aᵀ)⁻¹ wanted, (N, 2): the force by which the contact moves as wanted."""
    along = np.sum(across * wanted, axis=1) / (1.0 + np.sum(across**2, axis=1))
    return np.asarray(wanted - across * along[:, None])
