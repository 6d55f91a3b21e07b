"""Meshes that lie on their side, are in millimetres, or are cut below the table."""

import functools
from pathlib import Path

import numpy as np
import pytest
import trimesh

from taxeld.layout import read as layouts
from taxeld_training.cli import main
from taxeld_training.objects import meshes
from taxeld_training.objects.doubts import TURNS, doubts
from taxeld_training.objects.setting import HEIGHT_M, OBJECTS

SKIN = layouts.load("cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015")


@functools.cache
def loaded(name: str) -> trimesh.Trimesh:
    return meshes.load(meshes.find(name)[0])


def turned(mesh: trimesh.Trimesh, turn: np.ndarray) -> trimesh.Trimesh:
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    made = mesh.copy()
    made.apply_transform(matrix)
    return made


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_that_stands_is_not_doubted(name: str) -> None:
    assert doubts(loaded(name), SKIN, HEIGHT_M) == []


@pytest.mark.parametrize(
    "name", ["002_master_chef_can", "006_mustard_bottle", "024_bowl", "025_mug"]
)
@pytest.mark.parametrize("turn", TURNS)
def test_an_object_on_its_side_is_one_line_that_names_the_turn(name: str, turn: str) -> None:
    """The turn that is named leaves an object that stands."""
    lying = turned(loaded(name), TURNS[turn])
    (line,) = doubts(lying, SKIN, HEIGHT_M)
    assert "the mesh's z axis must point up: turn it by " in line
    named = line.partition("turn it by ")[2].partition(" if")[0]
    assert doubts(turned(lying, TURNS[named]), SKIN, HEIGHT_M) == []


def test_taxels_below_the_table_are_one_line_with_the_height_that_is_enough() -> None:
    mug = loaded("025_mug")
    (line,) = doubts(mug, SKIN, 0.02)
    assert line.startswith("16 of 80 taxels lie below its lowest point")
    assert "by up to 10 mm" in line
    assert line.endswith("--height-m 0.030 or more")
    assert doubts(mug, SKIN, 0.03) == []


def test_a_small_object_in_millimetres_is_doubted() -> None:
    """A larger one is refused."""
    nut = trimesh.creation.cylinder(radius=1.0, height=2.0)
    (line,) = doubts(nut, SKIN, 1.0)
    assert line.startswith("it is 2 m large")
    assert line.endswith("scale it by 0.001")


def test_the_scene_command_warns_after_its_report_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "can.stl", tmp_path / "can.png"
    can = trimesh.creation.cylinder(radius=0.05, height=0.14, sections=24)
    turned(can, TURNS["90° about y"]).export(path)
    assert main(["scene", str(path), "--png", str(out)]) == 0
    told, warned = capsys.readouterr()
    assert told.startswith("extents     140 × 100 × 100 mm\n")
    assert warned.startswith(f"taxeld-train: {path}: warning: it rests on 2")
    assert warned.count("\n") == 1
    assert out.read_bytes().startswith(b"\x89PNG")
    assert main(["scene", str(path), "--png", str(tmp_path / "no" / "can.png")]) == 2
    assert "--png: cannot write" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("size", "cure"), [(80.0, "scale it, by 0.001 if it is in millimetres"), (8e-5, "scale it up")]
)
def test_a_mesh_in_another_unit_is_refused_with_the_right_cure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], size: float, cure: str
) -> None:
    path = tmp_path / "box.stl"
    trimesh.creation.box((size, size, size)).export(path)
    assert main(["scene", str(path)]) == 2
    assert capsys.readouterr().err.endswith(f"meshes must be in metres: {cure}\n")
