"""A scene: an object as the skin meets it, K signed distance grids and nothing more.

The object never tips, so only the heights where taxels are matter. Each slice holds horizontal
signed distances [m], negative inside; slices are filled, since a skin is pressed from outside and
gives way past a thin wall. The object frame is the mesh file's own (x, y, yaw).
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from taxeld.arrays import Floats, Grid, Index
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout

CONTINUOUS = 0  # the `symmetry` of an object of revolution
HEIGHT_TOLERANCE_M = 0.006  # a slice serves taxels within this height; slices stand 10 mm apart
FINEST_M, FARTHEST_M = 1e-5, 10.0  # m: least grid spacing, and limit of all lengths
EDGE = 1.5  # cells: about so far are points of an edge apart
MOST_TURNS = 360  # the highest order of a symmetry


@dataclass(frozen=True)
class Scene:
    """One object at one height on one skin. Lengths in metres."""

    slices: Grid  # (K, ny, nx) signed distance at each of the skin's heights
    silhouette: Grid  # (ny, nx) signed distance to the union of the slices
    heights: Floats  # (K,) heights of the slices in the sensor frame
    origin: Floats  # (2,) position of grid point [0, 0]
    cell: float  # grid spacing
    outline: Floats  # (P, 2) points on the silhouette's largest part, in order
    surface: Floats  # (Q, 3) points on the object's surface at the skin's heights, for ADD
    symmetry: int  # order of the geometric rotation symmetry; CONTINUOUS, or 1 for none
    centre: Floats  # (2,) centre of that symmetry
    # (I, Q, 2) as `outline`, of each other part, as a kettle's handle is; older files have none
    islands: Floats = field(default_factory=lambda: np.empty((0, 1, 2)))

    def __post_init__(self) -> None:
        shapes = {
            "slices": (None, None, None),
            "silhouette": (None, None),
            "heights": (None,),
            "origin": (2,),
            "outline": (None, 2),
            "surface": (None, 3),
            "centre": (2,),
        }
        if len(self.islands):
            shapes["islands"] = (None, None, 2)
        for name, shape in shapes.items():
            _check(name, getattr(self, name), shape)
        slices, ny, nx = self.slices.shape
        if self.silhouette.shape != (ny, nx) or self.heights.shape != (slices,):
            raise SetupError("scene: slices, silhouette and heights do not belong together")
        if min(ny, nx) < 2 or len(self.outline) < 3:
            raise SetupError("scene: empty grid, or no outline")
        if not FINEST_M <= self.cell <= FARTHEST_M:
            raise SetupError(f"scene: cell is not within {FINEST_M:g} to {FARTHEST_M:g} m")
        if not 0 <= self.symmetry <= MOST_TURNS:
            raise SetupError(f"scene: symmetry is not within 0 to {MOST_TURNS}")

    @property
    def outlines(self) -> list[Floats]:
        """Points (P, 2) on each part of the silhouette, in order, of the largest part first."""
        return [self.outline, *self.islands]

    @property
    def extent(self) -> tuple[Floats, Floats]:
        """Lower and upper corner of the grid, (2,) each."""
        ny, nx = self.silhouette.shape
        return self.origin, self.origin + self.cell * np.array([nx - 1, ny - 1])

    @cached_property
    def size(self) -> float:
        """Largest distance of the outline from the centre."""
        return float(np.linalg.norm(self.outline - self.centre, axis=1).max())

    @cached_property
    def mean_radius(self) -> float:
        """Mean distance of the outline from the centre."""
        return float(np.linalg.norm(self.outline - self.centre, axis=1).mean())

    @cached_property
    def edge(self) -> Floats:
        """(E, 2) points all along the silhouette's edges, 1 to 2 cells apart."""
        row, column = np.nonzero(np.abs(self.silhouette) < self.cell)
        if not len(row):
            return self.outline
        at = self.origin + self.cell * np.column_stack([column, row])
        distance, gx, gy = self.clearance(*at.T)
        at -= distance[:, None] * np.column_stack([gx, gy])
        square = np.round(at / (EDGE * self.cell)).astype(np.intp)
        return np.asarray(at[np.unique(square, axis=0, return_index=True)[1]])

    @cached_property
    def reach(self) -> float:
        """Largest distance of an edge from the centre, of all parts."""
        return float(np.linalg.norm(self.edge - self.centre, axis=1).max())

    def slice_of(self, layout: Layout) -> Index:
        """(M,) the slice that serves each taxel.

        Raises:
            SetupError: a taxel's height has no slice.
        """
        gap = np.abs(layout.position_m[:, 2, None] - self.heights)
        if gap.min(axis=1).max() > HEIGHT_TOLERANCE_M:
            raise SetupError(
                f"scene: has no slice at a height of the layout {layout.name}; build it again"
            )
        return np.asarray(gap.argmin(axis=1))

    def clearance(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Signed distance of points (x, y) to the silhouette, and its unit gradient's x and y. All
        arrays are (N,). Outside the grid the nearest border value is used."""
        ny, nx = self.silhouette.shape
        flat = self.silhouette.ravel()
        u = np.clip((x - self.origin[0]) / self.cell, 0.0, nx - 1.001)
        v = np.clip((y - self.origin[1]) / self.cell, 0.0, ny - 1.001)
        iu, iv = u.astype(np.intp), v.astype(np.intp)
        u -= iu
        v -= iv
        at = iv * nx + iu
        d00, d01 = flat.take(at), flat.take(at + 1)
        d10, d11 = flat.take(at + nx), flat.take(at + nx + 1)
        low = d00 + (d01 - d00) * u
        high = d10 + (d11 - d10) * u
        gx, gy = (d01 - d00) * (1.0 - v) + (d11 - d10) * v, high - low
        norm = np.maximum(np.hypot(gx, gy), 1e-9)
        return low + (high - low) * v, gx / norm, gy / norm


def _check(name: str, array: object, shape: tuple[int | None, ...]) -> None:
    """Raise SetupError unless `array` holds lengths in this shape; None in a shape allows any."""
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f" or array.ndim != len(shape):
        raise SetupError(f"scene: {name} is no array of {len(shape)} dimensions of lengths")
    for size, wanted in zip(array.shape, shape, strict=True):
        if size == 0 or wanted not in {None, size}:
            raise SetupError(f"scene: {name} has the shape {array.shape}")
    if not np.abs(array).max() <= FARTHEST_M:
        raise SetupError(f"scene: {name} is not finite, or beyond {FARTHEST_M:g} m")
