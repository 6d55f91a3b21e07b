"""What an object rests on, and how it gives way to a push: a quasi-static world.

The object's load rests on points of its base, each with friction of its own, and the skin holds the
object by Coulomb friction as well. It gives way when the skin presses deeper than its friction
resists. It moves so that friction takes as little power as the push allows (the principle of
maximum dissipation, Goyal et al. 1991), which is what an ellipsoid as limit surface approximates.
Points, loads and friction differ from trial to trial, and no filter knows them.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.push import Push
from taxeld.model.scene import Scene
from taxeld.model.symmetry import PoseMetric

DEPTH_M = 0.003  # depth of the skin at which the object's friction gives way
SETTLING = 4  # steps of projection that end the overlap
TOLD_SPREAD = 0.2  # sd of a push by a known ground, as a share of its length
CLOSE_M = 1e-9  # a smaller depth is no overlap
POINTS = 16
LOAD_SHAPE = 1.5  # shape of the gamma distribution of a point's load
FRICTION = 0.2, 0.6  # friction of the skin on the object, least and most
STEPS = 40  # rounds of reweighting
STILL = 1e-3  # least speed of a point, as a share of the contact's


@dataclass(frozen=True)
class Ground:
    """Points (P, 2) in the object's frame, their loads (P,), which sum to 1, and the friction of
    the skin on the object."""

    points: Floats
    load: Floats
    friction: float

    @classmethod
    def drawn(cls, scene: Scene, rng: np.random.Generator) -> Self:
        """Points evenly inside the outline, as seen from the centre."""
        rim = scene.outline[rng.integers(len(scene.outline), size=POINTS)]
        inside = np.sqrt(rng.random((POINTS, 1)))
        load = rng.gamma(LOAD_SHAPE, size=POINTS)
        points = scene.centre + inside * (rim - scene.centre)
        return cls(points, load / load.sum(), float(rng.uniform(*FRICTION)))

    @property
    def centre(self) -> Floats:
        """(2,) of the load."""
        return np.asarray(self.load @ self.points)

    def slide(self, contact: Floats, wanted: Floats, inwards: Floats) -> Floats:
        """(N, 3) motions of the object in its own frame, (x, y) of its origin and turn.

        The skin touches it at `contact` (N, 2) and moves on by `wanted` (N, 2). The object must
        follow at least the part along the normal `inwards` (N, 2). A contact sticks while the force
        that this takes is inside the friction cone; else it slips along the cone's edge.
        """
        n = len(contact)
        hold = np.zeros((n, 2, 3))
        hold[:, 0, 0] = hold[:, 1, 1] = 1.0
        hold[:, 0, 2], hold[:, 1, 2] = -contact[:, 1], contact[:, 0]
        motion, force = self._least(hold, wanted)
        normal = np.sum(force * inwards, axis=1)
        sideways = force - normal[:, None] * inwards
        size = np.linalg.norm(sideways, axis=1)
        slips = size > self.friction * normal
        if slips.any():
            edge = inwards + (self.friction / np.maximum(size, 1e-12))[:, None] * sideways
            along = np.einsum("ni,nij->nj", edge[slips], hold[slips])
            slipped, _ = self._least(along[:, None], np.ones((len(along), 1)))
            followed = np.einsum("ni,nij,nj->n", inwards[slips], hold[slips], slipped)
            needed = np.sum(wanted[slips] * inwards[slips], axis=1)
            motion[slips] = slipped * (needed / followed)[:, None]
        return motion

    def _least(self, hold: Floats, wanted: Floats) -> tuple[Floats, Floats]:
        """The motions v (N, 3) of least dissipated power with `hold` (N, k, 3) v = `wanted`
        (N, k), and the forces (N, k) that they take, by weighted least squares over and over."""
        x, y = self.points.T
        n, k = wanted.shape
        size = np.linalg.norm(wanted, axis=1)[:, None]
        speed = np.repeat(size, len(x), axis=1)
        system = np.zeros((n, 3 + k, 3 + k))
        system[:, 3:, :3], system[:, :3, 3:] = hold, -hold.transpose(0, 2, 1)
        right = np.concatenate([np.zeros((n, 3)), wanted], axis=1)[:, :, None]
        for _ in range(STEPS):
            w = self.load / np.maximum(speed, STILL * size)
            system[:, 0, 0] = system[:, 1, 1] = w.sum(axis=1)
            system[:, 0, 2] = system[:, 2, 0] = -(w @ y)
            system[:, 1, 2] = system[:, 2, 1] = w @ x
            system[:, 2, 2] = w @ (x * x + y * y)
            found = np.linalg.solve(system, right)[:, :, 0]
            speed = np.hypot(found[:, :1] - found[:, 2:3] * y, found[:, 1:2] + found[:, 2:3] * x)
        return found[:, :3], found[:, 3:]


def gave_way(
    model: ObservationModel,
    ground: Ground,
    poses: Poses,
    before: Poses,
    after: Poses,
    depth_m: float = DEPTH_M,
    *,
    limited: bool = False,
) -> tuple[Poses, Floats]:
    """The object's poses (N, 3) once the sensor has moved from one pose (3,) to another and presses
    `depth_m` deep, and how far each was pushed (N,): with `limited` no farther than the sensor
    went, so that a pose that overlaps the skin from the start is not thrown out of it."""
    pushed, limit = np.zeros(len(poses)), np.full(len(poses), np.inf)
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
        if limited and moved.any():
            limit = np.maximum(along, 0.0)
        gives = np.clip(model.layout.radius_m - clearance - depth_m, 0.0, limit - pushed)
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


def by_ground(ground: Ground) -> Push:
    """`model.push.push` by the world's own ground: the limit of what can be known of a push, as
    no filter knows what the object rests on."""

    def push(
        model: ObservationModel,
        metric: PoseMetric,
        poses: Poses,
        assumed: Floats,
        before: Poses,
        after: Poses,
        depth_m: float,
        rng: np.random.Generator,
    ) -> tuple[Poses, Floats]:
        """Like `model.push.push`: poses (N, 3), sensor poses `before` (3,) and `after` (3,) →
        poses (N, 3), and how far each was pushed (N,) [m]; `assumed` (N, 4) is not used."""
        del assumed
        poses, pushed = gave_way(model, ground, poses, before, after, depth_m, limited=True)
        noise = TOLD_SPREAD * pushed[:, None] * rng.standard_normal((len(poses), 3))
        centre = metric.centres(poses) + noise[:, :2]
        return metric.placed(centre, poses[:, 2] + noise[:, 2] / model.scene.mean_radius), pushed

    return push
