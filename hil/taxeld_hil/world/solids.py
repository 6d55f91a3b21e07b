"""Solids as signed distances in three dimensions, negative inside; z as in the sensor's frame."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats


class Solid(Protocol):
    """An object whose frame is its mesh's own in x and y."""

    @property
    def centre(self) -> Floats:
        """(2,) of a circle around it."""

    @property
    def size(self) -> float:
        """Radius of the circle around the centre [m]."""

    def distance(self, points: Floats) -> Floats:
        """Signed distance [m] of points (3, n) [m] → (n,); far from the surface it may be a lower
        bound."""


@dataclass(frozen=True)
class Grid:
    """A solid sampled on a grid around its surface; beyond the grid its border's values stand."""

    values: NDArray[np.float32]  # (nz, ny, nx) signed distance
    origin: Floats  # (3,) of grid point [0, 0, 0]: x, y, z
    cell: float
    centre: Floats
    size: float

    def distance(self, points: Floats) -> Floats:
        """Like `Solid.distance`: points (3, n) [m] → (n,) [m], interpolated."""
        nz, ny, nx = self.values.shape
        at = (points - self.origin[:, None]) / self.cell
        np.clip(at, 0.0, np.array([[nx], [ny], [nz]]) - 1.001, out=at)
        cell = at.astype(np.intp)
        u, v, w = at - cell
        flat = self.values.ravel()
        base = (cell[2] * ny + cell[1]) * nx + cell[0]
        value = np.zeros(len(u))
        for dz, share in ((0, 1.0 - w), (ny * nx, w)):
            at_z = base + dz
            low = flat.take(at_z) * (1.0 - u) + flat.take(at_z + 1) * u
            high = flat.take(at_z + nx) * (1.0 - u) + flat.take(at_z + nx + 1) * u
            value += share * (low * (1.0 - v) + high * v)
        return value
