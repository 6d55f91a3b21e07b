"""Broken and misplaced meshes: a reported repair, a warning or one clear line, never silence."""

import functools
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from taxeld.layout import read as layouts
from taxeld_sim.objects import HEIGHT_M, meshes, scenes
from taxeld_training.cli import main
from taxeld_training.objects.report import TURNS, doubts
from tests.rig.commands import printed, refused

from .rig import PAPER_RING, THREE_ROWS, can, handle, tube

SKIN, PAPER = layouts.load(THREE_ROWS), layouts.load(PAPER_RING)
HERE_M = 0.05  # of the sensor frame above the lowest point
AREA_M2 = np.pi * 0.05**2
UNUSABLE = "faces: degenerate, duplicate or not finite"
HANDLE_M2 = 0.02 * 0.08 - 0.01 * np.sqrt(0.0024) - 0.05**2 * np.arcsin(0.2)  # outside the can

Array = NDArray[np.float64]


def remade(change: Callable[[Array, Array], tuple[Array, Array]]) -> trimesh.Trimesh:
    """A can with its vertices and faces changed."""
    made = can()
    vertices, faces = change(made.vertices.copy(), made.faces.copy())
    return trimesh.Trimesh(vertices, faces, process=False)


def without(lost: Callable[[Array], NDArray[np.bool_]]) -> trimesh.Trimesh:
    """A can without some faces, by their centres."""
    mesh = can()
    mesh.update_faces(~lost(mesh.triangles_center))
    return mesh


def slit() -> trimesh.Trimesh:
    """Without one face of the wall, as wide as a gap of 2.5 mm."""
    return without(lambda centre: (np.abs(centre[:, 1]) < 0.001) & (centre[:, 0] > 0.03))


def half() -> trimesh.Trimesh:
    return without(lambda centre: centre[:, 0] > 0.02)


def prism(corners: Array) -> trimesh.Trimesh:
    """An upright wall around a polygon, without lids."""
    n = len(corners)
    low, high = (np.column_stack([corners, np.full(n, z)]) for z in (0.0, 0.1))
    k = np.arange(n)
    j = (k + 1) % n
    faces = np.vstack([np.column_stack([k, j, j + n]), np.column_stack([k, j + n, k + n])])
    return trimesh.Trimesh(np.vstack([low, high]), faces, process=False)


def star() -> trimesh.Trimesh:
    """A pentagram: five points and the pentagon between them, 1.1226 R²."""
    angle = np.arange(5) * 4 * np.pi / 5
    return prism(0.06 * np.column_stack([np.cos(angle), np.sin(angle)]))


def sheet(length_m: float) -> trimesh.Trimesh:
    corners = [[0, 0, 0], [length_m, 0, 0], [length_m, 0, 0.1], [0, 0, 0.1]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])


def scaled(factor: float) -> trimesh.Trimesh:
    mesh = can()
    mesh.apply_scale(factor)
    return mesh


BOW = prism(np.array([[-0.05, -0.04], [0.05, 0.04], [0.05, -0.04], [-0.05, 0.04]]))
BROKEN = {  # a mesh, its repairs, and the area of its outlines
    "sound": (can(), [], AREA_M2),
    "open": (slit(), ["closed 3 gaps of at most 2.5 mm in the outlines"], AREA_M2),
    "inside out": (
        remade(lambda vertices, faces: (vertices, faces[:, ::-1])),
        [],
        AREA_M2,
    ),
    "some inside out": (
        remade(lambda vertices, faces: (vertices, np.vstack([faces[1::2], faces[::2, ::-1]]))),
        [],
        AREA_M2,
    ),
    "faces too many": (
        remade(lambda v, faces: (v, np.vstack([faces, faces[:5], [[0, 0, 1], [3, 4, 4]]]))),
        [f"dropped 7 of 519 {UNUSABLE}"],
        AREA_M2,
    ),
    "not finite": (
        remade(lambda v, faces: (np.where(np.arange(len(v))[:, None] == 7, np.nan, v), faces)),
        [f"dropped 5 of 512 {UNUSABLE}", "closed 3 gaps of at most 4.0 mm in the outlines"],
        AREA_M2,
    ),
    "crosses itself": (star(), [], 1.1226 * 0.06**2),
    # four lines meet where the lobes touch, which makes trimesh's loops ambiguous
    "two that share a corner": (BOW, [], 0.004),
    "two that overlap": (trimesh.util.concatenate([can(), handle()]), [], AREA_M2 + HANDLE_M2),
    "hollow": (tube(0.045), [], AREA_M2),
    "a loose sheet inside": (trimesh.util.concatenate([can(), sheet(0.02)]), [], AREA_M2),
}


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".glb"])
@pytest.mark.parametrize("name", BROKEN)
def test_repairs_are_reported_and_the_outline_is_whole(
    name: str, suffix: str, tmp_path: Path
) -> None:
    mesh, repairs, area_m2 = BROKEN[name]
    mesh.export(tmp_path / f"broken{suffix}")
    repaired = meshes.load(tmp_path / f"broken{suffix}")
    assert scenes.repairs(repaired, SKIN, HERE_M) == repairs
    for outline in scenes.outlines(repaired, SKIN, HERE_M):
        assert np.isclose(outline.shape.area, area_m2, rtol=2e-3)


def test_an_outline_in_many_pieces_is_put_together(tmp_path: Path) -> None:
    mesh = can().subdivide().subdivide()
    mesh.update_faces(np.random.default_rng(1).random(len(mesh.faces)) > 0.01)
    mesh.export(tmp_path / "pieces.stl")
    cuts = scenes.outlines(meshes.load(tmp_path / "pieces.stl"), SKIN, HERE_M)
    assert sum(len(outline.closed_m) for outline in cuts) > 10
    assert np.allclose([outline.shape.area for outline in cuts], AREA_M2, rtol=2e-3)


NAN = trimesh.Trimesh(can().vertices * np.nan, can().faces, process=False)
NO_FACES = b"solid nothing\nendsolid nothing\n"


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("half.stl", half(), r"is open, .* mm above .* gap of 9\d\.\d mm.*; fill"),
        ("mm.stl", scaled(1000.0), "100 m large; meshes must be in metres: scale it, by 0.001 if"),
        ("tiny.stl", scaled(0.001), "0.0001 m large; meshes must be in metres"),
        ("flat.stl", sheet(0.1), "is flat; export a solid"),
        ("nan.stl", NAN, rf"no triangles \(dropped 512 of 512 {UNUSABLE}\); export"),
        ("empty.stl", b"", "is an empty file; export it again"),
        ("empty.glb", b"", "is an empty file; export it again"),
        ("nothing.stl", NO_FACES, "holds no triangles; export"),
        ("cut.stl", b"\x80" * 1000, "perhaps cut short"),
        ("notes.txt", b"hello", r"\.txt is not read; export STL, PLY or OBJ"),
        ("bracket.STEP", b"ISO-10303-21;", r"\.step is not read; export STL, PLY or OBJ"),
        ("dangling.obj", b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nf 1 2 9\n", "unreadable mesh"),
        ("03_craker_box", None, "no such YCB object; did you mean .*003_cracker_box"),
        ("sofa", None, "no such YCB object; or give a mesh file"),
        ("nowhere/mesh.stl", None, "no such mesh file"),
    ],
)
def test_what_is_no_solid_in_metres_is_refused_in_one_line_with_its_cure(
    name: str,
    content: trimesh.Trimesh | bytes | None,
    fault: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    if isinstance(content, bytes):
        Path(name).write_bytes(content)
    elif content is not None:
        content.export(name)
    said = refused("scene", name, main=main)
    assert said.startswith("taxeld-train: ")
    assert re.search(f"{name}: .*{fault}", said)


def test_the_scene_command_prints_a_report(tmp_path: Path) -> None:
    slit().export(tmp_path / "can.stl")
    text = printed("scene", tmp_path / "can.stl", "--height-m", "0.04", main=main)
    lines = dict(line.split(maxsplit=1) for line in text.splitlines()[:5])
    assert lines["extents"] == "100 × 100 × 100 mm"
    assert lines["slices"].startswith("5, 10 to 70 mm")
    assert lines["symmetry"] == "continuous"
    assert lines["repairs"] == "closed 5 gaps of at most 2.5 mm in the outlines"
    said = refused("scene", tmp_path / "can.stl", "--height-m", "3", main=main)
    assert "change --height-m" in said


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
