"""Broken and misplaced meshes: a reported repair, a warning or one clear line, never silence."""

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from taxeld.arrays import Bools
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld_hil.objects import HEIGHT_M, meshes, scenes
from taxeld_training.cli import main
from taxeld_training.objects.report import TURNS, doubts
from tests.rig.commands import printed, refused

from .rig import PAPER_RING, THREE_ROWS, can, handle

SKIN, PAPER = layouts.load(THREE_ROWS), layouts.load(PAPER_RING)
HERE_M = 0.05  # of the sensor frame above the lowest point
AREA_M2 = np.pi * 0.05**2


def without(lost: Callable[[NDArray[np.float64]], Bools]) -> trimesh.Trimesh:
    mesh = can()
    mesh.update_faces(~lost(mesh.triangles_center))
    return mesh


def slit(centre: NDArray[np.float64]) -> Bools:
    """One face of the wall, as wide as a gap of 2.5 mm."""
    return np.asarray((np.abs(centre[:, 1]) < 0.001) & (centre[:, 0] > 0.03))


def half(centre: NDArray[np.float64]) -> Bools:
    return np.asarray(centre[:, 0] > 0.02)


def inside_out() -> trimesh.Trimesh:
    mesh = can()
    mesh.invert()
    return mesh


def some_inside_out() -> trimesh.Trimesh:
    mesh = can()
    faces = mesh.faces.copy()
    faces[::7] = faces[::7, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def with_faces_too_many() -> trimesh.Trimesh:
    mesh = can()
    faces = np.vstack([mesh.faces, mesh.faces[:5], [[0, 0, 1], [3, 4, 4]]])
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def with_a_vertex_that_is_not_finite() -> trimesh.Trimesh:
    mesh = can()
    vertices = mesh.vertices.copy()
    vertices[7] = np.nan
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def prism(corners: NDArray[np.float64]) -> trimesh.Trimesh:
    """An upright wall around a polygon, without lids."""
    n = len(corners)
    low, high = (np.column_stack([corners, np.full(n, z)]) for z in (0.0, 0.1))
    k = np.arange(n)
    j = (k + 1) % n
    faces = np.vstack([np.column_stack([k, j, j + n]), np.column_stack([k, j + n, k + n])])
    return trimesh.Trimesh(np.vstack([low, high]), faces, process=False)


def cut(mesh: trimesh.Trimesh, z_m: float) -> BaseGeometry:
    return meshes.outline(mesh, z_m).shape


def load(mesh: trimesh.Trimesh, place: Path, suffix: str = ".stl") -> trimesh.Trimesh:
    path = (place / "broken").with_suffix(suffix)
    mesh.export(path)
    return meshes.load(path)


@pytest.mark.parametrize(
    ("mesh", "repairs"),
    [
        (can(), []),
        (without(slit), ["closed 3 gaps of at most 2.5 mm in the outlines"]),
        (inside_out(), ["turned 512 faces outward"]),
        (some_inside_out(), ["turned 74 faces outward"]),
        (with_faces_too_many(), ["dropped 2 degenerate faces", "dropped 5 duplicate faces"]),
        (
            with_a_vertex_that_is_not_finite(),
            [
                "dropped 5 faces with vertices that are not finite",
                "closed 3 gaps of at most 4.0 mm in the outlines",
            ],
        ),
    ],
    ids=["sound", "open", "inside out", "some inside out", "faces too many", "not finite"],
)
@pytest.mark.parametrize("suffix", [".stl", ".ply", ".glb"])
def test_repairs_are_reported_and_the_outline_is_whole(
    mesh: trimesh.Trimesh, repairs: list[str], suffix: str, tmp_path: Path
) -> None:
    repaired = load(mesh, tmp_path, suffix)
    assert scenes.repairs(repaired, SKIN, HERE_M) == repairs
    for outline in scenes.outlines(repaired, SKIN, HERE_M):
        assert np.isclose(outline.shape.area, AREA_M2, rtol=2e-3)
    assert repaired.volume > 0.0


def test_an_outline_in_many_pieces_is_put_together(tmp_path: Path) -> None:
    mesh = can().subdivide().subdivide()
    mesh.update_faces(np.random.default_rng(1).random(len(mesh.faces)) > 0.01)
    repaired = load(mesh, tmp_path)
    cuts = scenes.outlines(repaired, SKIN, HERE_M)
    assert sum(len(outline.closed_m) for outline in cuts) > 10
    assert np.allclose([outline.shape.area for outline in cuts], AREA_M2, rtol=2e-3)


def test_an_outline_that_crosses_itself_is_untangled(tmp_path: Path) -> None:
    """A pentagram is five points and the pentagon between them: 1.1226 R²."""
    angle = np.arange(5) * 4 * np.pi / 5
    star = load(prism(0.06 * np.column_stack([np.cos(angle), np.sin(angle)])), tmp_path)
    assert scenes.repairs(star, SKIN, HERE_M) == ["untangled 3 self-crossing outlines"]
    assert np.isclose(cut(star, 0.03).area, 1.1226 * 0.06**2, rtol=1e-3)


@pytest.mark.parametrize("z_m", [0.03, 0.05])
def test_solids_that_share_a_corner_are_both_in_the_outline(z_m: float) -> None:
    """Four lines meet where the lobes touch, which makes trimesh's loops ambiguous."""
    bow = prism(np.array([[-0.05, -0.04], [0.05, 0.04], [0.05, -0.04], [-0.05, 0.04]]))
    assert np.isclose(cut(bow, z_m).area, 0.004, rtol=1e-3)


def test_solids_that_overlap_are_one() -> None:
    mesh = trimesh.util.concatenate([can(), handle()])
    assert scenes.repairs(mesh, SKIN, HERE_M) == []
    assert cut(mesh, 0.05).geom_type == "Polygon"
    assert AREA_M2 < cut(mesh, 0.05).area < AREA_M2 + 0.06 * 0.02


def test_a_loose_sheet_inside_is_left_alone() -> None:
    corners = [[0, 0, 0], [0.02, 0, 0], [0.02, 0, 0.1], [0, 0, 0.1]]
    sheet = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])
    mesh = trimesh.util.concatenate([can(), sheet])
    assert scenes.repairs(mesh, SKIN, HERE_M) == []
    assert np.isclose(cut(mesh, 0.05).area, AREA_M2, rtol=2e-3)


@pytest.mark.parametrize("z_m", [0.035, 0.05])
def test_an_outline_with_a_large_gap_is_refused(z_m: float, tmp_path: Path) -> None:
    mesh = load(without(half), tmp_path)
    fault = rf"broken\.stl: is open, .* {z_m * 1e3:.0f} mm above .* gap of 9\d\.\d mm.*; fill"
    with pytest.raises(SetupError, match=fault):
        cut(mesh, z_m)


def scaled(factor: float) -> trimesh.Trimesh:
    mesh = can()
    mesh.apply_scale(factor)
    return mesh


def sheet() -> trimesh.Trimesh:
    corners = [[0, 0, 0], [0.1, 0, 0], [0.1, 0, 0.1], [0, 0, 0.1]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("mesh", "fault"),
    [
        (scaled(1000.0), "100 m large; meshes must be in metres: scale it, by 0.001 if"),
        (scaled(0.001), "0.0001 m large; meshes must be in metres"),
        (sheet(), "is flat; export a solid"),
        (
            trimesh.Trimesh(can().vertices * np.nan, can().faces, process=False),
            r"holds no triangles \(left after repair: dropped 512 faces .* finite\); export",
        ),
    ],
    ids=["millimetres", "tiny", "flat", "no number"],
)
def test_an_unusable_mesh_is_refused_in_one_line_with_its_cure(
    mesh: trimesh.Trimesh, fault: str, tmp_path: Path
) -> None:
    with pytest.raises(SetupError, match=rf"broken\.stl: .*{fault}") as caught:
        load(mesh, tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("empty.stl", b"", "is an empty file; export it again"),
        ("empty.glb", b"", "is an empty file; export it again"),
        ("nothing.stl", b"solid nothing\nendsolid nothing\n", "holds no triangles; export"),
        ("cut.stl", b"\x80" * 1000, "perhaps cut short"),
        ("notes.txt", b"hello", r"\.txt is not read; export STL, PLY or OBJ"),
        ("bracket.STEP", b"ISO-10303-21;", r"\.step is not read; export STL, PLY or OBJ"),
        ("dangling.obj", b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nf 1 2 9\n", "unreadable mesh"),
    ],
)
def test_a_file_that_is_no_mesh_is_refused_in_one_line(
    name: str, content: bytes, fault: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SetupError, match=f"{name}: .*{fault}") as caught:
        meshes.load(path)
    assert "\n" not in str(caught.value)


def test_the_scene_command_prints_a_report(tmp_path: Path) -> None:
    path = tmp_path / "can.stl"
    without(slit).export(path)
    lines = dict(
        line.split(maxsplit=1) for line in printed("scene", path, main=main).splitlines()[:5]
    )
    assert lines["extents"] == "100 × 100 × 100 mm"
    assert lines["slices"].startswith("5, 10 to 70 mm")
    assert lines["symmetry"] == "continuous"
    assert lines["repairs"] == "closed 5 gaps of at most 2.5 mm in the outlines"
    report = printed("scene", "025_mug", "--height-m", "0.04", main=main)
    assert "symmetry    none" in report
    assert "grid error  rms 0.0" in report


def test_the_scene_command_refuses_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "half.stl"
    without(half).export(path)
    for arguments in ([str(path)], ["sofa"], ["025_mug", "--height-m", "3"]):
        assert refused("scene", *arguments, main=main).startswith("taxeld-train: ")


@functools.cache
def loaded(name: str) -> trimesh.Trimesh:
    return meshes.load(meshes.find(name)[0])


def turned(mesh: trimesh.Trimesh, turn: np.ndarray) -> trimesh.Trimesh:
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    made = mesh.copy()
    made.apply_transform(matrix)
    return made


@pytest.mark.parametrize("name", ["002_master_chef_can", "025_mug"])
@pytest.mark.parametrize("turn", TURNS)
def test_an_object_on_its_side_is_one_line_that_names_the_turn(name: str, turn: str) -> None:
    """The turn that is named leaves an object that stands."""
    lying = turned(loaded(name), TURNS[turn])
    (line,) = doubts(lying, PAPER, HEIGHT_M)
    assert "the mesh's z axis must point up: turn it by " in line
    named = line.partition("turn it by ")[2].partition(" if")[0]
    assert doubts(turned(lying, TURNS[named]), PAPER, HEIGHT_M) == []


def test_taxels_below_the_table_are_one_line_with_the_height_that_is_enough() -> None:
    mug = loaded("025_mug")
    (line,) = doubts(mug, PAPER, 0.02)
    assert line.startswith("16 of 80 taxels lie below its lowest point")
    assert "by up to 10 mm" in line
    assert line.endswith("--height-m 0.030 or more")
    assert doubts(mug, PAPER, 0.03) == []


def test_a_small_object_in_millimetres_is_doubted() -> None:
    """A larger one is refused."""
    (line,) = doubts(can(32, 1.0, 2.0), PAPER, 1.0)
    assert line.startswith("it is 2 m large")
    assert line.endswith("scale it by 0.001")


def test_the_scene_command_warns_after_its_report_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "can.stl", tmp_path / "can.png"
    turned(can(24, 0.05, 0.14), TURNS["90° about y"]).export(path)
    assert main(["scene", str(path), "--png", str(out)]) == 0
    told, warned = capsys.readouterr()
    assert told.startswith("upright ")
    assert "\nextents     140 × 100 × 100 mm\n" in told
    assert warned.startswith(f"taxeld-train: {path}: warning: it rests on 2")
    assert warned.count("\n") == 1
    assert out.read_bytes().startswith(b"\x89PNG")
    assert main(["scene", str(path), "--png", str(tmp_path / "no" / "can.png")]) == 2
    assert "--png: cannot write" in capsys.readouterr().err
