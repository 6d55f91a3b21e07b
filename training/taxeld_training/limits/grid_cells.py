"""The cells of the grid filter: boxes that tile the poses at which the skin touches the object.

At a touch the skin presses the object 0..δ_max deep. Cells tile this band in contact coordinates:
along the level sets of the silhouette's distance (s), across them (δ), and in the direction from
which the object is touched (φ). Each is a parallelepiped of axis positions and turns, so a prior
that is uniform over poses gives a cell its volume as weight.
"""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import Scene
from taxeld_training.models.frames import level_sets

FIRST_M, FIRST_DEEP_M, FIRST_RAD = 0.005, 0.00125, np.deg2rad(5.0)  # extents of the first cells


@dataclass(slots=True)
class Cells:
    """n parallelepipeds of (axis x, axis y [m], turn [rad]): where the skin's axis stands at the
    first touch, in the object's frame, and the object's turn in the sensor's frame of that touch.
    """

    mid: Floats  # (n, 3) midpoints
    edge: Floats  # (n, 3, 3) edges, side to side: along the contact curve, across it, in turn
    log_volume: Floats  # (n,) log of the cell's volume [m² rad]
    log_likelihood: Floats  # (n,) log-likelihood of the scans, averaged over the cell's poses
    log_likelihood_max: Floats  # (n,) upper bound of the log-likelihood of the cell's best pose
    information: Floats  # (n, 3) Fisher information along each edge, times the cell's variance

    @classmethod
    def unweighed(cls, mid: Floats, edge: Floats, log_volume: Floats) -> Self:
        """Cells without likelihood: midpoints (n, 3), edges (n, 3, 3), log volumes (n,)."""
        n = len(mid)
        return cls(mid, edge, log_volume, np.zeros(n), np.zeros(n), np.zeros((n, 3)))

    def __len__(self) -> int:
        return len(self.mid)

    def __getitem__(self, which: Bools) -> "Cells":
        return Cells(*(getattr(self, field.name)[which] for field in fields(self)))

    @property
    def log_effective_volume(self) -> Floats:
        """(n,) log of each cell's volume, or of the likelihood's where that is narrower."""
        return np.asarray(self.log_volume - 0.5 * np.log1p(self.information).sum(axis=1))

    @property
    def weight(self) -> Floats:
        """(n,) prior times likelihood, integrated over each cell; sums to 1."""
        log_mass = self.log_likelihood + self.log_effective_volume
        mass = np.exp(log_mass - log_mass.max())
        return np.asarray(mass / mass.sum())

    @property
    def log_evidence(self) -> float:
        """log of the scans' probability, averaged over the prior, up to a constant."""
        log_mass = self.log_likelihood + self.log_effective_volume
        return float(log_mass.max() + np.log(np.exp(log_mass - log_mass.max()).sum()))

    @property
    def log_weight_max(self) -> Floats:
        """(n,) upper bound of the log of `weight`: as if all of a cell were its best pose."""
        log_volume = self.log_effective_volume
        return np.asarray(self.log_likelihood_max + log_volume - self.log_evidence)

    def joined(self, other: "Cells") -> "Cells":
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return Cells(*(np.concatenate(pair) for pair in pairs))

    def halved(self) -> "Cells":
        """Twice as many, not weighed yet: each cut across the edge of most information."""
        cut = np.arange(len(self)), self.information.argmax(axis=1)
        edge = self.edge.copy()
        edge[cut] *= 0.5
        step = 0.5 * edge[cut]
        mid = np.concatenate([self.mid - step, self.mid + step])
        log_volume = np.tile(self.log_volume - np.log(2.0), 2)
        return Cells.unweighed(mid, np.concatenate([edge, edge]), log_volume)


def tile(model: ObservationModel, margin_m: float = 0.0) -> Cells:
    """The first cells: every pose that presses the silhouette 0..δ_max deep, or would if the skin
    were up to `margin_m` elsewhere, is in one of them."""
    scene = model.scene
    depth_m = model.depth_max_m + 2.0 * margin_m
    layers = max(round(depth_m / FIRST_DEEP_M), 1)
    deep = depth_m / layers
    # Each depth has its own level set. The normals of a single curve would leave out a wedge at a
    # concave corner and crowd at a convex one.
    sheets = [
        _along(scene, loop, radius, deep)
        for radius in model.layout.radius_m + margin_m - (np.arange(layers) + 0.5) * deep
        for loop in level_sets(scene, radius)
    ]
    turns = round(2.0 * np.pi / FIRST_RAD)
    mid = np.repeat(np.concatenate([sheet[0] for sheet in sheets]), turns, axis=0)
    edge = np.repeat(np.concatenate([sheet[1] for sheet in sheets]), turns, axis=0)
    mid[:, 2] = np.tile((np.arange(turns) + 0.5) * 2.0 * np.pi / turns, len(mid) // turns)
    edge[:, 2, 2] = 2.0 * np.pi / turns
    return Cells.unweighed(mid, edge, np.log(np.abs(np.linalg.det(edge))))


def _along(scene: Scene, loop: Floats, radius_m: float, deep_m: float) -> tuple[Floats, Floats]:
    """Midpoints (n, 3) and edges (n, 3, 3) of cells along a level set, their turn still zero."""
    knots = np.concatenate([[0.0], np.linalg.norm(np.diff(loop, axis=0), axis=1).cumsum()])
    n = max(round(knots[-1] / FIRST_M), 1)
    at, length = (np.arange(n) + 0.5) / n * knots[-1], knots[-1] / n
    axis = np.column_stack([np.interp(at, knots, loop[:, i]) for i in (0, 1)])
    _, gx, gy = scene.clearance(*axis.T)
    tangent = np.column_stack([-gy, gx])
    # Along the curve the cell's turn follows the normal, so that φ is constant: readings determine
    # φ sharply and, at a corner, not θ. The clip matters at a kink, where the normal jumps.
    before, after = (_normal(scene, axis + side * length * tangent) for side in (-0.5, 0.5))
    most = length / (radius_m - deep_m)
    bend = np.clip(se2.wrap(before - after), -most, most)
    edge = np.zeros((n, 3, 3))
    edge[:, 0] = np.column_stack([length * tangent, bend])
    edge[:, 1, :2] = deep_m * np.column_stack([gx, gy])
    return np.column_stack([axis, np.zeros(n)]), edge


def _normal(scene: Scene, points: Floats) -> Floats:
    """Direction (n,) of the silhouette's distance at points (n, 2)."""
    _, gx, gy = scene.clearance(*points.T)
    return np.asarray(np.arctan2(gy, gx))
