"""The grid error: what grids look up, against exact distances to the outlines."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from taxeld.layout import read as layouts
from taxeld.model.scene import Scene
from taxeld_training.objects import scenes
from taxeld_training.objects.scene_error import GridError, grid_error

SKIN = layouts.load("cylinder:rows=3,columns=8,radius_m=0.04,pitch_m=0.015")


def can() -> trimesh.Trimesh:
    mesh = trimesh.creation.cylinder(0.05, 0.1, sections=128)
    mesh.apply_translation([0.0, 0.0, 0.05])
    return mesh


def measure(scene: Scene, mesh: trimesh.Trimesh) -> GridError:
    return grid_error(scene, mesh, SKIN, 0.04, 0.005, points=200)


def test_a_smooth_solid_is_exact_to_the_grids_curvature() -> None:
    """A bilinear lookup of a distance to a circle of 50 mm errs by cell² / 8 / 43 mm at most."""
    mesh = can()
    error = measure(scenes.build(mesh, SKIN, 0.04), mesh)
    assert error.rms < error.p99 <= error.max < 0.04


@pytest.mark.parametrize("grid", ["slices", "silhouette"])
def test_an_offset_grid_is_detected(grid: str) -> None:
    mesh = can()
    scene = scenes.build(mesh, SKIN, 0.04)
    wrong = replace(scene, **{grid: getattr(scene, grid) + np.float32(0.001)})
    assert np.isclose(measure(wrong, mesh).max, 1.0, atol=0.05)


def test_a_lost_outline_is_detected() -> None:
    scene = scenes.build(can(), SKIN, 0.04)
    lost = scene.slices.copy()
    lost[1] = scenes.FAR_M
    assert measure(replace(scene, slices=lost), can()).max > 900.0


def test_a_moved_grid_is_detected() -> None:
    scene = scenes.build(can(), SKIN, 0.04)
    moved = replace(scene, origin=scene.origin + np.array([0.001, 0.0]))
    assert 0.5 < measure(moved, can()).rms < 1.0


def test_walls_that_no_skin_touches_do_not_count() -> None:
    """The grids are filled: neither a wall's inside nor a solid inside another one is an error."""
    tube = trimesh.creation.annulus(0.047, 0.05, 0.1, sections=128)
    tube.apply_translation([0.0, 0.0, 0.05])
    handle = trimesh.creation.box((0.06, 0.02, 0.1))
    handle.apply_translation([0.05, 0.0, 0.05])
    for mesh in (tube, trimesh.util.concatenate([can(), handle])):
        assert measure(scenes.build(mesh, SKIN, 0.04), mesh).max < 1.0
