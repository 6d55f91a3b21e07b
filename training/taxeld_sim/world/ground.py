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
from taxeld.model.scene import Scene

DEPTH_M = 0.003  # depth of the skin at which the object's friction gives way
SETTLING = 4  # steps of projection that end the overlap
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

    def slide(self, contact: Floats, wanted: Floats, inwards: Floats) -> Floats:
        """(3,) motion of the object in its own frame, (x, y) of its origin and turn.

        The skin touches it at `contact` (2,) and moves on by `wanted` (2,). The object must follow
        at least the part along the normal `inwards` (2,). A contact sticks while the force that
        this takes is inside the friction cone; else it slips along the cone's edge.
        """
        hold = np.array([[1.0, 0.0, -contact[1]], [0.0, 1.0, contact[0]]])
        motion, force = self._least(hold, wanted)
        normal = force @ inwards
        sideways = force - normal * inwards
        size = float(np.linalg.norm(sideways))
        if size > self.friction * normal:
            edge = inwards + self.friction / max(size, 1e-12) * sideways
            slipped, _ = self._least(edge[None] @ hold, np.ones(1))
            motion = slipped * (wanted @ inwards) / (inwards @ hold @ slipped)
        return np.asarray(motion)

    def _least(self, hold: Floats, wanted: Floats) -> tuple[Floats, Floats]:
        """The motion v (3,) of least dissipated power with `hold` (k, 3) v = `wanted` (k,), and the
        forces (k,) that it takes, by weighted least squares over and over."""
        x, y = self.points.T
        least = STILL * float(np.linalg.norm(wanted))
        speed = np.full(len(x), least / STILL)
        right = np.append(np.zeros(3), wanted)
        system = np.zeros((len(right), len(right)))
        system[3:, :3], system[:3, 3:] = hold, -hold.T
        for _ in range(STEPS):
            w = self.load / np.maximum(speed, least)
            wx, wy = w @ x, w @ y
            system[:3, :3] = [
                [w.sum(), 0.0, -wy],
                [0.0, w.sum(), wx],
                [-wy, wx, w @ (x * x + y * y)],
            ]
            found = np.linalg.solve(system, right)
            speed = np.hypot(found[0] - found[2] * y, found[1] + found[2] * x)
        return np.asarray(found[:3]), np.asarray(found[3:])


def gave_way(
    model: ObservationModel, ground: Ground, pose: Poses, before: Poses, after: Poses
) -> Poses:
    """The object's pose (3,), which was `pose` (3,), once the sensor has moved from one pose (3,)
    to another."""
    moved = after[:2] - before[:2]
    for _ in range(SETTLING):
        axis = np.concatenate(contacts.axis_in_object(se2.compose(se2.inverse(after), pose)[None]))
        clearance, *away = (float(each[0]) for each in model.scene.clearance(*axis[:, None]))
        gives = model.layout.radius_m - clearance - DEPTH_M
        if gives <= CLOSE_M:
            break
        inwards = -np.array(away)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        seen = np.array([[c, s], [-s, c]]) @ moved
        wanted = gives * inwards + seen - (seen @ inwards) * inwards
        pose = se2.compose(pose, ground.slide(axis + clearance * inwards, wanted, inwards))
        moved = np.zeros(2)
    return pose
