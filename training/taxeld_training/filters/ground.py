"""What an object rests on, and how it slides when it is pushed.

The load rests on points of the base, each with friction of its own, and the skin holds the object
by Coulomb friction as well. The object moves so that friction takes as little power as the push
allows (the principle of maximum dissipation, Goyal et al. 1991), which is what an ellipsoid as
limit surface approximates. A filter knows neither the points nor their loads nor the friction.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from taxeld.arrays import Floats
from taxeld.model.scene import Scene

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
        """(N, 3) motions of the object in its own frame, (x, y) of its origin and turn, where the
        skin touches it at `contact` (N, 2) and moves on by `wanted` (N, 2), of which at least the
        part along the normal `inwards` (N, 2) must be followed. A contact sticks while the force
        that this takes is inside the friction cone; else it slips along the cone's edge."""
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
