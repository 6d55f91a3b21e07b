"""A scene: an object as the skin meets it, K signed distance grids and nothing more.

The object never tips, so only the heights where taxels are matter. Each slice holds horizontal
signed distance [m], negative inside; slices are filled, since a skin is pressed from outside and
gives way past a thin wall. The object frame is the mesh file's own (x, y, yaw).
"""

import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taxeld import se2
from taxeld.errors import SetupError
from taxeld.layout import Layout

CONTINUOUS = 0  # the `symmetry` of an object of revolution
HEIGHT_TOLERANCE_M = 0.006  # a taxel is served by the slice this near; slices stand 10 mm apart

Floats = NDArray[np.float64]
Grid = NDArray[np.float32]


@dataclass(frozen=True)
class Scene:
    """One object at one height on one skin. Lengths in metres."""

    slices: Grid  # (K, ny, nx) signed distance at each of the skin's heights
    silhouette: Grid  # (ny, nx) signed distance to the union of the slices
    heights: Floats  # (K,) in the sensor frame
    origin: Floats  # (2,) position of grid point [0, 0]
    cell: float  # grid spacing
    outline: Floats  # (P, 2) points on the silhouette, in order
    surface: Floats  # (Q, 3) points on the object's surface at the skin's heights, for ADD
    symmetry: int  # order of the geometric rotation symmetry; CONTINUOUS, or 1 for none
    centre: Floats  # (2,) of that symmetry

    def __post_init__(self) -> None:
        slices, ny, nx = self.slices.shape
        if self.silhouette.shape != (ny, nx) or self.heights.shape != (slices,):
            raise SetupError("scene: slices, silhouette and heights do not belong together")
        if min(slices, ny - 1, nx - 1) < 1 or not self.cell > 0 or self.symmetry < 0:
            raise SetupError("scene: empty grid")
        arrays = (self.slices, self.silhouette, self.heights, self.outline, self.surface)
        if not all(np.isfinite(a).all() for a in arrays):
            raise SetupError("scene: a grid holds values that are not finite")

    @property
    def extent(self) -> tuple[Floats, Floats]:
        """Lower and upper corner of the grid."""
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
    def equivalents(self) -> Floats:
        """(n, 3) poses that touch cannot tell apart, the identity first.

        An object of revolution is sampled every 10°: ample for errors in millimetres.
        """
        n = 36 if self.symmetry == CONTINUOUS else self.symmetry
        return np.array([se2.rotation_about(self.centre, 2.0 * np.pi * k / n) for k in range(n)])

    def slice_of(self, layout: Layout) -> NDArray[np.intp]:
        """(M,) the slice that serves each taxel.

        Raises:
            SetupError: a taxel's height has no slice.
        """
        gap = np.abs(layout.position_m[:, 2, None] - self.heights)
        if gap.min(axis=1).max() > HEIGHT_TOLERANCE_M:
            raise SetupError(f"scene has no slice at a height of layout {layout.name}")
        return np.asarray(gap.argmin(axis=1))

    def clearance(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Signed distance of points to the silhouette, and its unit gradient's x and y. Outside the
        grid the nearest border value stands."""
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

    def save(self, path: Path) -> None:
        fields = {name: np.asarray(getattr(self, name)) for name in self.__dataclass_fields__}
        np.savez_compressed(path, allow_pickle=False, **fields)


def load(path: Path) -> Scene:
    """Read and validate `scene.npz`; nothing in it is ever unpickled.

    Raises:
        SetupError: the file is missing, truncated, or not a scene.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as npz:
            missing = sorted(Scene.__dataclass_fields__.keys() - set(npz.files))
            if missing:
                raise SetupError(f"{path}: lacks {', '.join(missing)}; build the bundle again")
            values = {name: npz[name] for name in Scene.__dataclass_fields__}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SetupError(f"{path}: unreadable scene ({error}); build the bundle again") from None
    values["cell"] = float(values["cell"])
    values["symmetry"] = int(values["symmetry"])
    return Scene(**values)
