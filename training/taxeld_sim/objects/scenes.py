"""Scenes from meshes: slices at the skin's heights, their grids, symmetry and surface points."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from taxeld.arrays import Floats
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model.scene import CONTINUOUS, Scene
from taxeld.model.symmetry import USUAL_RADIUS_M
from taxeld_sim.objects import meshes

CELL_M = 0.002  # cell of an object of half the usual size or more; halved with each half of that
GRAIN_M = 2.0**-16  # distances are kept to 15 µm: finer digits are noise and do not compress
MARGIN_M = 0.025  # grid beyond the reach of the cylinder, so that uniform poses surround the object
SLICE_STEP_M = 0.01  # heights nearer than this share a slice
FAR_M = 1.0  # the distance of a slice that misses the object
OUTLINE_POINTS, ISLAND_POINTS = 256, 64
SURFACE_POINTS_PER_SLICE = 64

# An outline turned by less than these from itself counts as symmetric: a scan of a slightly leaning
# box does, the handle of a mug does not. Of a smaller object less, as its cells are.
SYMMETRY_RMS_M = 0.0015
SYMMETRY_MAX_M = 0.005
SYMMETRY_ORDERS = (12, 10, 9, 8, 7, 6, 5, 4, 3, 2)


def build(mesh: trimesh.Trimesh, layout: Layout, height_m: float) -> Scene:
    """The scene of `mesh` on `layout`, whose frame's origin is `height_m` above its lowest point.

    Raises:
        SetupError: the skin passes above or below the whole object, or the mesh is open there.
    """
    heights = _heights(layout)
    shapes = [outline.shape for outline in outlines(mesh, layout, height_m)]
    union = meshes.fill(shapely.union_all(shapes))
    if union.is_empty:
        raise SetupError(
            f"no taxel is at a height of the object: its {mesh.extents[2] * 1e3:.0f} mm lie "
            f"outside the skin's {heights.min() + height_m:.3f}..{heights.max() + height_m:.3f} m; "
            "change --height-m"
        )
    cell = CELL_M * fineness(union)
    parts = sorted(shapely.get_parts(union), key=lambda part: -part.area)
    islands = [_around(part, ISLAND_POINTS) for part in parts[1:]]
    x, y, origin = grid(union, layout.radius_m + MARGIN_M, cell)
    order, centre = symmetry(shapes, union)
    return Scene(
        slices=np.stack([_distance(shape, x, y) for shape in shapes]),
        silhouette=_distance(union, x, y),
        heights=heights,
        origin=origin,
        cell=cell,
        outline=_around(parts[0], OUTLINE_POINTS),
        surface=_surface(shapes, heights),
        symmetry=order,
        centre=centre,
        islands=np.reshape(islands, (-1, ISLAND_POINTS, 2)),
    )


def build_all(mesh: trimesh.Trimesh, at: Sequence[tuple[Layout, float]]) -> list[Scene]:
    """The scene of `mesh` on each of several links: their layouts, and the heights of their frames'
    origins above its lowest point. What turns leave it unchanged is a question of all heights.

    Raises:
        SetupError: as of `build`.
    """
    scenes = [build(mesh, *link) for link in at]
    if len(scenes) == 1:
        return scenes
    shapes = [cut.shape for link in at for cut in outlines(mesh, *link)]
    order, centre = symmetry(shapes, meshes.fill(shapely.union_all(shapes)))
    surface = scenes[0].surface
    return [replace(s, symmetry=order, centre=centre, surface=surface) for s in scenes]


def outlines(mesh: trimesh.Trimesh, layout: Layout, height_m: float) -> list[meshes.Outline]:
    """The mesh's outline at each of the skin's heights."""
    bottom = float(mesh.bounds[0][2])
    return [meshes.outline(mesh, bottom + height_m + z) for z in _heights(layout)]


def repairs(mesh: trimesh.Trimesh, layout: Layout, height_m: float) -> list[str]:
    """The repairs of the mesh and of its outlines, in words; empty for a sound mesh."""
    cuts = outlines(mesh, layout, height_m)
    found = list(mesh.metadata.get("repairs", []))
    gaps = [gap for cut in cuts for gap in cut.closed_m]
    if gaps:
        s = "s" * (len(gaps) != 1)
        found.append(
            f"closed {len(gaps)} gap{s} of at most {max(gaps) * 1e3:.1f} mm in the outlines"
        )
    return found


def fineness(union: BaseGeometry) -> float:
    """1 for an object of half the usual size or more, 1/2 for one of a quarter or more, and so on:
    the mean radius of its outline against that for which lengths are given."""
    around = _around(_largest(union), OUTLINE_POINTS)
    radius_m = float(np.linalg.norm(around - union.centroid.coords[0], axis=1).mean())
    return float(2.0 ** min(np.ceil(np.log2(radius_m / USUAL_RADIUS_M)), 0.0))


def symmetry(shapes: list[BaseGeometry], union: BaseGeometry) -> tuple[int, Floats]:
    """Order of the rotation symmetry (CONTINUOUS, n, or 1) and its centre (2,)."""
    centre = np.array(union.centroid.coords[0])
    fine = fineness(union)
    if all(_same_when_turned(shapes, centre, angle, fine) for angle in (2.0, 0.7, 0.3)):
        return CONTINUOUS, centre
    for order in SYMMETRY_ORDERS:
        if _same_when_turned(shapes, centre, 2.0 * np.pi / order, fine):
            return order, centre
    return 1, centre


def _same_when_turned(
    shapes: list[BaseGeometry], centre: Floats, angle: float, fine: float
) -> bool:
    c, s = np.cos(angle), np.sin(angle)
    gaps = []
    for shape in shapes:
        if shape.is_empty:
            continue
        points = np.concatenate([_around(part, 200) for part in shapely.get_parts(shape)])
        turned = (points - centre) @ np.array([[c, s], [-s, c]]) + centre
        gaps.append(shapely.distance(shape.boundary, shapely.points(turned)))
    gap = np.concatenate(gaps)
    rms = float(np.sqrt(np.mean(gap**2)))
    return bool(rms < fine * SYMMETRY_RMS_M and gap.max() < fine * SYMMETRY_MAX_M)


def _heights(layout: Layout) -> Floats:
    """Mean heights of groups of taxels that lie within SLICE_STEP_M."""
    z = np.sort(layout.position_m[:, 2])
    groups: list[list[float]] = []
    for value in z:
        if groups and value - groups[-1][0] < SLICE_STEP_M:
            groups[-1].append(value)
        else:
            groups.append([value])
    return np.array([0.5 * (group[0] + group[-1]) for group in groups])


def grid(shape: BaseGeometry, margin: float, cell: float) -> tuple[Floats, Floats, Floats]:
    """x and y (ny, nx) of points about a shape, a margin beyond it; and the first one (2,)."""
    x0, y0, x1, y1 = shape.bounds
    xs = np.arange(x0 - margin, x1 + margin + cell, cell)
    ys = np.arange(y0 - margin, y1 + margin + cell, cell)
    x, y = np.meshgrid(xs, ys)
    return x, y, np.array([xs[0], ys[0]])


def _distance(shape: BaseGeometry, x: Floats, y: Floats) -> NDArray[np.float32]:
    if shape.is_empty:
        return np.full(x.shape, FAR_M, dtype=np.float32)
    distance = meshes.signed_distance(shape, x, y)
    return np.round(distance / GRAIN_M).astype(np.float32) * np.float32(GRAIN_M)


def _largest(shape: BaseGeometry) -> BaseGeometry:
    return max(shapely.get_parts(shape), key=lambda part: part.area)


def _around(polygon: BaseGeometry, n: int) -> Floats:
    """(n, 2) points spaced evenly along a polygon's exterior."""
    ring = polygon.exterior
    at = np.linspace(0.0, ring.length, n, endpoint=False)
    return np.asarray(shapely.get_coordinates(shapely.line_interpolate_point(ring, at)))


def _surface(shapes: list[BaseGeometry], heights: Floats) -> Floats:
    """(Q, 3) points around every slice, the same number on each."""
    points = []
    for shape, z in zip(shapes, heights, strict=True):
        if not shape.is_empty:
            around = _around(_largest(shape), SURFACE_POINTS_PER_SLICE)
            points.append(np.column_stack([around, np.full(len(around), z)]))
    return np.concatenate(points)
