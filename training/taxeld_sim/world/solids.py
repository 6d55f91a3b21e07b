"""A mesh as outlines at many heights: a grid of signed distances, kept from one run to the next.

The daemon has an outline at each height of its taxels; a soft skin is pressed by what lies between
them as well. Outlines are filled, as a skin is pressed from outside.
"""

import hashlib
import os
import zipfile
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats

FORMAT = 6  # of a kept grid
CELL_M = 0.001
NEAR_M = 0.002  # distances are exact so near to the surface
MARGIN_M = 0.01  # width of the grid beside the object, and the largest distance
OFF_M = CELL_M / 3.0  # between a height and the next round one, at which meshes have flat faces


@dataclass(frozen=True)
class Solid:
    """Horizontal signed distances [m], negative inside, in the mesh's own x and y and the sensor's
    z; beyond the grid its border's values stand."""

    values: NDArray[np.float32]  # (nz, ny, nx)
    origin: Floats  # (3,) of grid point [0, 0, 0]: x, y, z
    centre: Floats  # (2,) of a circle around the object
    size: Floats  # () radius of that circle [m]

    def distance(self, points: Floats) -> Floats:
        """Signed distances (n,) of points (3, n) [m], interpolated; farther than NEAR_M from the
        surface they are right to a cell."""
        nz, ny, nx = self.values.shape
        at = (points - self.origin[:, None]) / CELL_M
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


def load(path: Path, height_m: float, reach_z_m: float, scale: float = 1.0) -> Solid:
    """The solid of a mesh file that is scaled first, in a frame `height_m` above its lowest point,
    as far as `reach_z_m` above and below that.

    Raises:
        SetupError: the mesh cannot be read, or is open there.
        ModuleNotFoundError: a package that reads meshes is not installed.
    """
    key = f"{FORMAT} {height_m:.6f} {reach_z_m:.6f} {scale} {CELL_M} {NEAR_M} {MARGIN_M}".encode()
    digest = hashlib.sha256(path.read_bytes() + key).hexdigest()
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    kept = caches / "taxeld" / "meshes" / f"{path.stem}-{digest[:16]}.npz"
    names = [field.name for field in fields(Solid)]
    with (
        suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile),
        kept.open("rb") as file,
        np.load(file, allow_pickle=False) as npz,
    ):
        return Solid(*(npz[name] for name in names))
    solid = build(path, height_m, reach_z_m, scale)
    with suppress(OSError):  # no place to keep it: built again the next time
        kept.parent.mkdir(parents=True, exist_ok=True)
        partial = kept.with_suffix(f".{os.getpid()}.npz")  # another process may do the same
        np.savez_compressed(partial, **{name: getattr(solid, name) for name in names})
        partial.rename(kept)
    return solid


def build(path: Path, height_m: float, reach_z_m: float, scale: float = 1.0) -> Solid:
    """As `load`, anew: that takes seconds."""
    import shapely  # noqa: PLC0415  (an extra)
    from scipy import ndimage  # noqa: PLC0415

    from taxeld_sim.objects import meshes, scenes  # noqa: PLC0415

    mesh = meshes.load(path)
    mesh.apply_scale(scale)
    heights = np.arange(OFF_M - reach_z_m, reach_z_m + CELL_M, CELL_M)
    bottom = float(mesh.bounds[0][2]) + height_m
    shapes = [meshes.outline(mesh, bottom + z).shape for z in heights]
    x, y, corner = scenes.grid(shapely.union_all(shapes), MARGIN_M, CELL_M)
    points = shapely.points(x, y)
    values = np.full((len(heights), *x.shape), MARGIN_M, np.float32)
    for shape, value in zip(shapes, values, strict=True):
        if shape.is_empty:
            continue
        shapely.prepare([shape, edge := shape.boundary])
        near = shapely.dwithin(edge, points, NEAR_M)
        distance = NEAR_M + CELL_M * (ndimage.distance_transform_edt(~near) - 1.0)
        distance[near] = shapely.distance(edge, points[near])
        distance = np.where(shapely.contains_xy(shape, x, y), -distance, distance)
        value[:] = np.minimum(distance, MARGIN_M)
    centre = mesh.bounds[:, :2].mean(axis=0)
    size = np.linalg.norm(mesh.vertices[:, :2] - centre, axis=1).max()
    return Solid(values, np.array([*corner, heights[0]]), centre, size)
