"""Errors of a scene's grids: what is looked up, against the exact distance at random points.

The outlines are those that the grids are made of (tests/training/test_meshes.py holds them against
known solids). Measured is what spacing, rounding and lookup make of them.
"""

from dataclasses import dataclass, replace

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout
from taxeld.model.scene import Scene
from taxeld_training.objects import meshes

POINTS = 1000  # a grid, the same ones at every call


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
    cell of the surface, in the silhouette as near to where the cylinder's axis is at a touch."""
    rng = np.random.default_rng(0)
    band = depth_max_m + scene.cell
    bottom = float(mesh.bounds[0][2]) + height_m
    shapes = [meshes.cut(mesh, bottom + z) for z in scene.heights]
    union = meshes.fill(shapely.union_all(shapes))
    measured = [(grid, shape, 0.0) for grid, shape in zip(scene.slices, shapes, strict=True)]
    measured.append((scene.silhouette, union, layout.radius_m))
    errors = []
    for grid, shape, away_m in measured:
        if shape.is_empty:
            continue
        at = _around(shape, max(away_m - band, 0.0), away_m + band, points, rng)
        exact = meshes.signed_distance(shape, *at.T)
        use = np.abs(exact - away_m) <= band
        errors.append(_lookup(scene, grid, at[use]) - exact[use])
    error = np.abs(np.concatenate(errors)) * 1e3
    rms = np.sqrt(np.mean(error**2))
    return GridError(float(rms), float(np.quantile(error, 0.99)), float(error.max()))


def _lookup(scene: Scene, grid: NDArray[np.float32], at: Floats) -> Floats:
    return replace(scene, silhouette=grid).clearance(at[:, 0], at[:, 1])[0]


def _around(
    shape: BaseGeometry, low: float, high: float, n: int, rng: np.random.Generator
) -> Floats:
    """(n, 2) random points, `low` to `high` [m] from random points of the shape's outline."""
    lines = shapely.get_parts(shape.boundary)
    length = shapely.length(lines)
    line = lines[rng.choice(len(lines), n, p=length / length.sum())]
    on = shapely.line_interpolate_point(line, rng.random(n), normalized=True)
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    away = rng.uniform(low, high, (n, 1))
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(shapely.get_coordinates(on) + away * way)
