"""A solid against a soft skin: closed forms, symmetry, and the estimator's model beside it."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from taxeld.arrays import Floats
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model import contacts
from taxeld.proposals import bundle
from taxeld_sim.objects import meshes
from taxeld_sim.trials.case import Case
from taxeld_sim.trials.play import world_of
from taxeld_sim.world import solids
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.mesh_skin import LAYER_M, MeshSkin
from taxeld_sim.world.robot import turned
from taxeld_sim.world.subjects import Subject, model_of, solid_of
from taxeld_sim.world.world import IDLE_S

RING = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
SKIN = layouts.load(RING)
HALF = np.array([0.05, 0.03, 0.04])
FACING = np.array([0.04 + 0.05, 0.0, 0.0])  # a box's face just touches column 0


@dataclass(frozen=True)
class Box:
    """An upright box around the origin, or so much higher, in closed form."""

    half: Floats
    z_m: float = 0.0
    centre = np.zeros(2)

    @property
    def size(self) -> float:
        return float(np.hypot(*self.half[:2]))

    def distance(self, points: Floats) -> Floats:
        out = np.abs(points - [[0.0], [0.0], [self.z_m]]) - self.half[:, None]
        outside = np.linalg.norm(np.maximum(out, 0.0), axis=0)
        return np.asarray(outside + np.minimum(out.max(axis=0), 0.0))


BOX = Box(HALF)
NO_SAG, SAG = np.zeros(len(SKIN)), np.full(len(SKIN), 0.003)


def hard(pose: Floats, solid: Any = BOX) -> Floats:
    """What points on a hard skin are pressed by."""
    return MeshSkin(solid, SKIN, 0.0, 0.005).indentation(pose, NO_SAG)


def soft(pose: Floats, solid: Any = BOX) -> Floats:
    """What electrodes are under a cover that sags by 1/e in 3 mm."""
    return MeshSkin(solid, SKIN, 0.002, 0.005).indentation(pose, SAG)


def pressed(depth_m: float) -> Floats:
    return FACING - np.array([depth_m, 0.0, 0.0])


@pytest.mark.parametrize("depth_m", [0.0005, 0.002, 0.0045])
def test_a_flat_press_is_as_deep_as_the_plane_stands_in_each_normals_way(depth_m: float) -> None:
    column = np.arctan2(SKIN.position_m[:, 1], SKIN.position_m[:, 0])
    way = (0.04 - depth_m) / np.maximum(np.cos(column), 1e-9)  # from the axis to the face
    expected = np.where(np.cos(column) > 0.0, np.clip(0.04 - way, 0.0, None), 0.0)
    np.testing.assert_allclose(hard(pressed(depth_m)), expected, atol=1e-9)
    assert hard(pressed(0.02)).max() == pytest.approx(LAYER_M), "no deeper than the skin"


@pytest.mark.parametrize("tilt", [(0.0, 0.1), (0.3, -0.4), (1.2, 0.9)])
def test_a_link_that_leans_is_pressed_along_its_own_normals(tilt: tuple[float, float]) -> None:
    """By a wall that is far larger than the link, in closed form."""
    turn = turned(np.array(tilt))
    place, normal = (each @ turn.T for each in (SKIN.position_m, SKIN.normal))
    wall_m = place[:, 0].max() - 0.003
    way = (place[:, 0] - wall_m) / np.maximum(normal[:, 0], 1e-9)
    expected = np.where((way > 0.0) & (normal[:, 0] > 0.0), way, 0.0)
    wall = Box(np.array([0.5, 0.5, 0.5]))
    skin = MeshSkin(wall, SKIN, 0.0, 0.005)
    depth = skin.indentation(np.array([wall_m + 0.5, 0.0, 0.0]), NO_SAG, turn)
    shallow = expected < LAYER_M
    np.testing.assert_allclose(depth[shallow], expected[shallow], atol=1e-9)
    assert np.count_nonzero(depth) > 1


@pytest.mark.parametrize("lean_rad", [0.1, 0.5])
def test_a_link_that_leans_presses_as_deep_as_one_that_is_upright(lean_rad: float) -> None:
    depths = []
    for lean in (0.0, lean_rad):
        given = Conditions(foam="typical", keys=(("sag_m", (0.0, 0.0)),), lean_rad=lean)
        world = world_of(Case((Subject("box"),), conditions=given, guide="random", touches=4), 0)
        times = world.touched_s().mean(axis=1)
        depths.append([float(world.step(t).depth.max()) for t in times])
        turns = [world.paths[0].turn(t - IDLE_S) for t in times]
        assert np.arccos([turn[2, 2] for turn in turns]) == pytest.approx(lean, abs=1e-6)
    upright, leaning = depths
    # an electrode reads the mean of its points, and upright an edge may fall between two of them
    assert all(low - 0.15 < found < 1.05 for low, found in zip(upright, leaning, strict=True))


def test_an_object_that_does_not_touch_indents_nothing() -> None:
    assert not soft(pressed(-1e-4)).any()
    assert not soft(np.array([1.0, 0.0, 0.3])).any()


def test_each_taxel_sags_by_its_own_length_and_one_of_length_0_not_at_all() -> None:
    """A rod of 2 mm presses 8 mm below one row of taxels, and 7 mm above the next."""
    skin = MeshSkin(Box(np.array([0.05, 0.05, 0.001]), -0.008), SKIN, 0.002, 0.005)
    lengths = np.zeros(len(SKIN))
    lengths[32], lengths[16] = 0.003, 0.006  # both column 0, in the rows beside the rod
    depth = skin.indentation(pressed(0.003), lengths)
    assert np.flatnonzero(depth).tolist() == [16, 32]
    np.testing.assert_allclose(
        depth[[32, 16]], 0.003 * np.exp([-8.0 / 3.0, -7.0 / 6.0]), rtol=1e-3
    )  # to where the skin's points stand


def test_an_edge_between_two_columns_is_read_by_a_soft_skin_alone() -> None:
    thin = Box(np.array([0.05, 0.003, 0.04]))
    between = np.pi / 16
    pose = np.array([*(0.087 * np.array([np.cos(between), np.sin(between)])), between])
    assert not hard(pose, thin).any()
    depth = soft(pose, thin)
    np.testing.assert_allclose(depth[0::16], depth[1::16], rtol=0.2)  # to the lattice
    assert depth[0] > 1e-4


def test_a_wall_thinner_than_the_press_is_read_as_deep_as_its_outside() -> None:
    """What the estimator does by filling its slices."""
    wall = Box(np.array([0.001, 0.03, 0.04]))
    pose = np.array([0.04 + 0.001 - 0.004, 0.0, 0.0])
    assert hard(pose, wall)[0] == pytest.approx(0.004, abs=1e-9)


def test_a_mesh_of_a_box_has_its_closed_form(tmp_path: Path) -> None:
    """Of a trilinear grid: exact beside faces, and off by less than a cell's half at edges."""
    path = tmp_path / "box.stl"
    trimesh.creation.box(2.0 * HALF).export(path)
    solid = solids.build(path, 0.04, reach_z_m=0.03)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 20_000)) * [[0.058], [0.038], [0.028]]
    true, found = Box(np.array([*HALF[:2], 1.0])).distance(points), solid.distance(points)
    near = np.abs(true) < 0.0015
    assert np.sqrt(np.mean((found - true)[near] ** 2)) < 5e-5
    assert np.abs(found - true)[near].max() < 5e-4
    clear = np.abs(true) > 0.001
    assert (np.sign(found) == np.sign(true))[clear].all()
    assert np.abs(found - true).max() < 0.0015
    assert solid.distance(np.array([[0.0], [0.0], [0.0]]))[0] < -0.02


@pytest.mark.parametrize("name", ["box", "mug", "024_bowl"])
def test_a_hard_skin_and_the_estimators_model_differ_by_little(name: str) -> None:
    """Nine in ten taxels within a millimetre, a bowl's thin wall among them; the rest are at edges,
    where the nearest way out and the way along a normal are not the same."""
    model = model_of(Subject(name), RING)
    skin = MeshSkin(solid_of(Subject(name), RING), SKIN, 0.0, 0.005)
    rng = np.random.default_rng(0)
    touches = contacts.synthesise(model.scene, SKIN.radius_m, 0.005, 200, rng)
    theirs = 0.005 * model.activation(touches.pose)
    ours = np.array([skin.indentation(pose, NO_SAG) for pose in touches.pose])
    gap = np.abs(ours - theirs)[(ours > 0.0) | (theirs > 0.0)]
    assert np.median(gap) < 3e-4
    assert np.quantile(gap, 0.9) < 1e-3


def test_a_mesh_is_built_once_and_again_without_a_usable_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path, _ = meshes.find("025_mug")
    first = solids.load(path, 0.04, 0.01)
    with monkeypatch.context() as patch:
        patch.setattr(solids, "build", lambda *_: pytest.fail("built again"))
        np.testing.assert_array_equal(solids.load(path, 0.04, 0.01).values, first.values)
        with pytest.raises(pytest.fail.Exception):
            solids.load(path, 0.05, 0.01)
    (kept,) = (tmp_path / "taxeld" / "meshes").iterdir()
    kept.write_bytes(kept.read_bytes()[:1000])
    np.testing.assert_array_equal(solids.load(path, 0.04, 0.01).values, first.values)
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    np.testing.assert_array_equal(solids.load(path, 0.04, 0.01).values, first.values)


def test_a_bundle_of_ones_own_mesh_holds_what_a_soft_skin_needs(tmp_path: Path) -> None:
    own = Path(shutil.copytree(bundle.find("box"), tmp_path / "block"))
    info = json.loads((own / "bundle.json").read_text(encoding="utf-8"))
    trimesh.creation.box((0.06, 0.1, 0.2)).export(own / "mesh.stl")
    (own / "bundle.json").write_text(json.dumps(info | {"object": "block"}), encoding="utf-8")
    with pytest.raises(SetupError, match="block: no such YCB object"):
        solid_of(Subject(str(own)), RING)
    named = info | {"object": "block", "mesh": "mesh.stl"}
    (own / "bundle.json").write_text(json.dumps(named), encoding="utf-8")
    distance = solid_of(Subject(str(own)), RING).distance(np.array([[0.0], [0.0], [0.0]]))
    assert distance[0] < -0.005
    beside = solid_of(Subject(str(own)), RING).distance(np.array([[0.032], [0.0], [0.0]]))
    assert beside[0] == pytest.approx(0.002, abs=3e-4)
