"""Errors of a scene's grids against the mesh: trimesh's exact distance, at random points.

Of the code that makes the grids only the choice of heights is used. The outlines are trimesh's
sections, the distance is trimesh's, and a winding number decides what is inside.
"""

from dataclasses import dataclass, replace

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from trimesh.proximity import closest_point_naive

from taxeld.arrays import Bools, Floats
from taxeld.layout.layout import Layout
from taxeld.model.scene import Scene
from taxeld_training.objects import meshes

POINTS = 1000  # a grid, the same ones at every call
CHUNK = 250  # points at once: their distances to all segments are held in memory
STEP_M = 1e-6


@dataclass(frozen=True)
class GridError:
    """Errors of the looked-up distance, all grids together [mm]."""

    rms: float
    p99: float
    max: float


def grid_error(
    scene: Scene,
    mesh: trimesh.Trimesh,
    layout: Layout,
    height_m: float,
    depth_max_m: float,
    points: int = POINTS,
) -> GridError:
    """Error of the lookup where the estimator uses it: in the slices within `depth_max_m` and a
    cell of the surface, in the silhouette as near to where the cylinder's axis is at a touch.

    Points whose exact depth is unknown, as a section crosses itself, are left out.
    """
    rng = np.random.default_rng(0)
    band = depth_max_m + scene.cell
    bottom = float(mesh.bounds[0][2]) + height_m
    sections = [_outer(_loops(mesh, bottom + z)) for z in scene.heights]
    errors = []
    for grid, loops in zip(scene.slices, sections, strict=True):
        if loops:
            at = _around(loops, 0.0, band, points, rng)
            exact, known = _signed_distance(loops, at)
            use = known & (np.abs(exact) <= band)
            errors.append(_lookup(scene, grid, at[use]) - exact[use])
    met = [loops for loops in sections if loops]
    every = [loop for loops in met for loop in loops]
    at = _around(every, layout.radius_m - band, layout.radius_m + band, points, rng)
    exact = np.min([_signed_distance(loops, at)[0] for loops in met], axis=0)
    use = np.abs(exact - layout.radius_m) <= band
    errors.append(_lookup(scene, scene.silhouette, at[use]) - exact[use])
    error = np.abs(np.concatenate(errors)) * 1e3
    rms = np.sqrt(np.mean(error**2))
    return GridError(float(rms), float(np.quantile(error, 0.99)), float(error.max()))


def _lookup(scene: Scene, grid: NDArray[np.float32], at: Floats) -> Floats:
    return replace(scene, silhouette=grid).clearance(at[:, 0], at[:, 1])[0]


def _loops(mesh: trimesh.Trimesh, z_m: float) -> list[Floats]:
    """Closed loops (n, 2) of the mesh's section, the last point not repeated.

    Where the section is not all loops, the outline as it was closed stands for it.
    """
    section = mesh.section(plane_origin=[0.0, 0.0, z_m], plane_normal=[0.0, 0.0, 1.0])
    if section is None:
        return []
    loops = meshes.loops(section)
    if not loops:
        parts = shapely.get_parts(meshes.cut(mesh, z_m))
        loops = [shapely.get_coordinates(part.exterior) for part in parts]
    loops = [loop[:-1] for loop in loops if len(loop)]
    return [loop for loop in loops if np.prod(np.ptp(loop, axis=0)) > meshes.MIN_AREA_M2]


def _outer(loops: list[Floats]) -> list[Floats]:
    """The loops that are not inside others."""
    kept: list[Floats] = []
    for loop in sorted(loops, key=lambda loop: -float(np.prod(np.ptp(loop, axis=0)))):
        if not _inside(kept, loop).all():
            kept.append(loop)
    return kept


def _around(
    loops: list[Floats], low: float, high: float, n: int, rng: np.random.Generator
) -> Floats:
    """(n, 2) random points, `low` to `high` from random points of the loops."""
    a = np.concatenate(loops)
    b = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    length = np.linalg.norm(b - a, axis=1)
    i = rng.choice(len(a), n, p=length / length.sum())
    on = a[i] + rng.random((n, 1)) * (b - a)[i]
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    away = rng.uniform(low, high, (n, 1))
    return np.asarray(on + away * np.column_stack([np.cos(angle), np.sin(angle)]))


def _signed_distance(loops: list[Floats], points: Floats) -> tuple[Floats, Bools]:
    """Exact distance to what the loops enclose, negative inside, and whether it is known.

    Inside, the nearest piece of a loop may lie in another loop; the depth is then unknown.
    """
    foot = np.concatenate(
        [_closest(loops, points[i : i + CHUNK]) for i in range(0, len(points), CHUNK)]
    )
    away = foot - points
    distance = np.linalg.norm(away, axis=1)
    inside = _inside(loops, points)
    beyond = foot + STEP_M * away / np.maximum(distance, STEP_M)[:, None]
    known = ~inside | ~_inside(loops, beyond)
    return np.where(inside, -distance, distance), known


def _closest(loops: list[Floats], points: Floats) -> Floats:
    """The loops' nearest points (n, 2). Each segment is the foot of an upright triangle, so that
    trimesh's distance in space is the horizontal one."""
    a = np.concatenate(loops)
    b = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    long = (a != b).any(axis=1)
    a, b = a[long], b[long]
    flat = np.concatenate([a, b, 0.5 * (a + b)])
    up = np.repeat([0.0, 0.0, 0.01], len(a))
    faces = np.arange(3 * len(a)).reshape(3, -1).T
    wall = trimesh.Trimesh(np.column_stack([flat, up]), faces, process=False)
    closest, _, _ = closest_point_naive(wall, np.column_stack([points, np.zeros(len(points))]))
    return np.asarray(closest[:, :2])


def _inside(loops: list[Floats], points: Floats) -> Bools:
    """Whether a loop winds around the points."""
    found = np.zeros(len(points), dtype=bool)
    x, y = points[:, :1], points[:, 1:]
    for a in loops:
        b = np.roll(a, -1, axis=0)
        left = (b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])
        up = (a[:, 1] <= y) & (b[:, 1] > y) & (left > 0.0)
        down = (a[:, 1] > y) & (b[:, 1] <= y) & (left < 0.0)
        found |= up.sum(axis=1) != down.sum(axis=1)
    return found
