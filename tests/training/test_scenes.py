"""Scenes from meshes with known shapes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import CONTINUOUS, Scene
from taxeld.pipeline.pipeline import _reach_m
from taxeld.proposals import manifest
from taxeld.stream import messages
from taxeld_hil.objects import meshes, scenes
from taxeld_hil.objects.scenes import GridError, grid_error
from taxeld_training.objects.report import doubts

from .rig import PAPER_RING, THREE_ROWS, box, can, handle, tube

SKIN = layouts.load(THREE_ROWS)


def aside(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.apply_translation([0.02, -0.01, 0.0])
    return mesh


@pytest.mark.parametrize(
    ("mesh", "order"),
    [
        (box(0.06, 0.16), 2),
        (box(0.1, 0.1), 4),
        (aside(can(3)), 3),
        (aside(can(6, 0.08)), 6),
        (aside(can()), CONTINUOUS),
        (trimesh.util.concatenate([can(), handle()]), 1),
    ],
    ids=["rectangle", "square", "triangle", "hexagon", "can", "can with a handle"],
)
def test_the_symmetry_is_found_from_the_geometry(mesh: trimesh.Trimesh, order: int) -> None:
    scene = scenes.build(mesh, SKIN, 0.04)
    assert scene.symmetry == order
    assert order == 1 or np.allclose(scene.centre, mesh.centroid[:2], atol=1e-3)


def test_a_small_object_is_held_to_its_own_size() -> None:
    """Sides of 20 and 22.5 mm are told apart as those of 80 and 90 mm are, and its cells are as
    fine: of a larger object they stay as they are."""
    thin = layouts.load("cylinder:rows=1,columns=8,radius_m=0.04,pitch_m=0.015")
    large, small = (scenes.build(box(x, y), thin, 0.05) for x, y in ((0.08, 0.09), (0.02, 0.0225)))
    assert large.symmetry == small.symmetry == 2
    assert (large.cell, small.cell) == (0.002, 0.0005)
    assert scenes.build(box(0.3, 0.3), thin, 0.05).cell == 0.002


def test_an_outline_is_all_parts_that_stand_apart_at_the_heights_of_the_taxels(
    tmp_path: Path,
) -> None:
    """A kettle's handle is an island there: in the scene, in its file, in what the stream and the
    place check know of it."""
    grip = box(0.02, 0.02, 0.02)
    grip.apply_translation([0.08, 0.0, 0.04])
    made = scenes.build(trimesh.util.concatenate([can(128, 0.03), grip]), SKIN, 0.05)
    manifest.save_scene(made, tmp_path / "scene.npz")
    scene = manifest.parse_scene((tmp_path / "scene.npz").read_bytes(), tmp_path)
    for name in ("slices", "surface", "symmetry"):
        assert np.array_equal(getattr(scene, name), getattr(made, name))
    told = messages.info(SKIN, {"kettle": scene}, "")
    for body, island in (scene.outlines, *(one["outlines"] for one in (told, *told["objects"]))):
        assert np.allclose(np.hypot(*np.transpose(body)), 0.03, atol=1e-4)
        off = np.abs(np.subtract(island, [0.08, 0.0])).max(axis=1)
        assert np.allclose(off, 0.01, atol=1e-4)
    assert scene.reach > 0.08
    assert _reach_m(ObservationModel(scene, SKIN, 0.005)) > 0.08 + SKIN.radius_m
    assert scenes.build(can(), SKIN, 0.05).islands.shape == (0, 64, 2)


def test_the_grid_is_the_distance_to_the_outline() -> None:
    """A box's signed distance has a closed form; the grid differs by its grain alone."""
    scene = scenes.build(box(0.06, 0.16), SKIN, 0.04)
    ny, nx = scene.silhouette.shape
    x = scene.origin[0] + scene.cell * np.arange(nx)[None, :]
    y = scene.origin[1] + scene.cell * np.arange(ny)[:, None]
    dx, dy = np.abs(x) - 0.03, np.abs(y) - 0.08
    exact = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)) + np.minimum(np.maximum(dx, dy), 0)
    assert np.abs(scene.silhouette - exact).max() < 2e-5
    assert np.array_equal(scene.slices[0], scene.silhouette)


def test_slices_follow_a_cone() -> None:
    cone = trimesh.creation.cone(0.08, 0.1, sections=128)
    scene = scenes.build(cone, SKIN, 0.04)
    inside = [np.count_nonzero(piece < 0) * scene.cell**2 for piece in scene.slices]
    radius = 0.08 * (1.0 - (0.04 + scene.heights) / 0.1)
    assert np.allclose(inside, np.pi * radius**2, rtol=0.05)
    assert np.count_nonzero(scene.silhouette < 0) == np.count_nonzero(scene.slices[0] < 0)


def test_a_slice_above_the_object_is_far_and_a_skin_above_all_of_it_is_refused() -> None:
    scene = scenes.build(box(0.1, 0.1), SKIN, 0.09)
    assert (scene.slices[-1] == scenes.FAR_M).all()
    with pytest.raises(SetupError, match="change --height-m"):
        scenes.build(box(0.1, 0.1), SKIN, 0.5)


TEN = {  # as a ring of five rows feels them, 10 to 70 mm above their lowest point
    "002_master_chef_can": CONTINUOUS,
    "003_cracker_box": 2,
    "006_mustard_bottle": 2,
    "016_pear": 1,
    "019_pitcher_base": CONTINUOUS,  # the handle begins above the ring
    "021_bleach_cleanser": 1,  # 2-fold slice by slice, but the scan leans, its foot by 4 mm
    "024_bowl": CONTINUOUS,
    "025_mug": 1,
    "035_power_drill": 1,
    "061_foam_brick": 2,
}


@pytest.mark.check
@pytest.mark.parametrize(("name", "order"), TEN.items())
def test_the_papers_objects_have_their_symmetry_and_exact_grids(name: str, order: int) -> None:
    skin = layouts.load(PAPER_RING)
    path, attribution = meshes.find(name)
    assert attribution is not None
    assert "CC BY 4.0" in attribution
    mesh = meshes.load(path)
    assert doubts(mesh, skin, 0.04) == []
    scene = scenes.build(mesh, skin, 0.04)
    assert scene.symmetry == order
    error = grid_error(scene, mesh, skin, 0.04, 0.005, points=300)
    assert 0.0 < error.rms < 0.2
    assert error.rms <= error.p99 <= error.max
    assert error.p99 < 0.6
    assert error.max < 1.5  # at an edge, under the grid's spacing


def measure(scene: Scene, mesh: trimesh.Trimesh) -> GridError:
    return grid_error(scene, mesh, SKIN, 0.04, 0.005, points=200)


def test_a_smooth_solid_is_exact_to_the_grids_curvature() -> None:
    """A bilinear lookup of a distance to a circle of 50 mm errs by cell² / 8 / 43 mm at most."""
    mesh = can()
    error = measure(scenes.build(mesh, SKIN, 0.04), mesh)
    assert error.rms < error.p99 <= error.max < 0.04


def test_a_grid_that_is_off_moved_or_lost_is_detected() -> None:
    mesh = can()
    scene = scenes.build(mesh, SKIN, 0.04)
    for grid in ("slices", "silhouette"):
        off = replace(scene, **{grid: getattr(scene, grid) + np.float32(0.001)})
        assert np.isclose(measure(off, mesh).max, 1.0, atol=0.05)
    moved = replace(scene, origin=scene.origin + np.array([0.001, 0.0]))
    assert 0.5 < measure(moved, mesh).rms < 1.0
    lost = scene.slices.copy()
    lost[1] = scenes.FAR_M
    assert measure(replace(scene, slices=lost), mesh).max > 900.0


def test_walls_that_no_skin_touches_do_not_count() -> None:
    """The grids are filled: neither a wall's inside nor a solid inside another one is an error."""
    for mesh in (tube(0.047), trimesh.util.concatenate([can(), handle()])):
        assert measure(scenes.build(mesh, SKIN, 0.04), mesh).max < 1.0
