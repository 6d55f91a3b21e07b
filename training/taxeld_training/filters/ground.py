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
LOAD_SHAPE = 1.5  # of the gamma distribution of a point's load
FRICTION = 0.2, 0.6  # of the skin on the object, least and most
STEPS = 40  # of reweighting
STILL = 1e-3  # of the contact's speed: slower points are taken to be so fast


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
        """(3,) the object's motion in its own frame, (x, y) of its origin and turn, where the skin
        touches it at `contact` (2,) and moves on by `wanted` (2,), of which at least the part along
        the normal `inwards` (2,) must be followed. The contact sticks while the force that this
        takes is inside the friction cone; else it slips along the cone's edge."""
        hold = np.array([[1.0, 0.0, -contact[1]], [0.0, 1.0, contact[0]]])
        motion, force = self._least(hold, wanted)
        normal = float(force @ inwards)
        sideways = force - normal * inwards
        size = float(np.linalg.norm(sideways))
        if size <= self.friction * normal:
            return motion
        edge = inwards + self.friction * sideways / max(size, 1e-12)
        motion, _ = self._least(edge[None] @ hold, np.ones(1))
        return np.asarray(motion * (wanted @ inwards) / (inwards @ hold @ motion))

    def _least(self, hold: Floats, wanted: Floats) -> tuple[Floats, Floats]:
        """The motion v (3,) of least dissipated power with `hold` (k, 3) v = `wanted` (k,), and the
        force (k,) that it takes, by weighted least squares over and over."""
        x, y = self.points.T
        k = len(wanted)
        speed = np.full(len(x), np.linalg.norm(wanted))
        system = np.zeros((3 + k, 3 + k))
        system[3:, :3], system[:3, 3:] = hold, -hold.T
        right = np.concatenate([np.zeros(3), wanted])
        least = STILL * float(np.linalg.norm(wanted))
        for _ in range(STEPS):
            w = self.load / np.maximum(speed, least)
            sx, sy = float(w @ x), float(w @ y)
            square = float(w @ (x * x + y * y))
            system[:3, :3] = [[w.sum(), 0.0, -sy], [0.0, w.sum(), sx], [-sy, sx, square]]
            found = np.linalg.solve(system, right)
            speed = np.hypot(found[0] - found[2] * y, found[1] + found[2] * x)
        return found[:3], found[3:]
