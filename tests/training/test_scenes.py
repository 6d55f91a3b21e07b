"""Scenes from meshes with known shapes."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh
from scipy import optimize

from taxeld.arrays import Floats, Poses
from taxeld.layout import read as layouts
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import CONTINUOUS, Scene
from taxeld.pipeline.pipeline import _reach_m
from taxeld.proposals import manifest
from taxeld.stream import messages
from taxeld_sim.objects import meshes, scenes
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.ground import DEPTH_M, Ground
from taxeld_sim.world.world import World
from taxeld_training.objects.report import doubts
from tests.rig.commands import refuses

from .rig import MODEL, PAPER_RING, SKIN, THREE_ROWS, box, can, handle, tube

THREE = layouts.load(THREE_ROWS)


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
    scene = scenes.build(mesh, THREE, 0.04)
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
    made = scenes.build(trimesh.util.concatenate([can(128, 0.03), grip]), THREE, 0.05)
    manifest.save_scene(made, tmp_path / "scene.npz")
    scene = manifest.parse_scene((tmp_path / "scene.npz").read_bytes(), tmp_path)
    for name in ("slices", "surface", "symmetry"):
        assert np.array_equal(getattr(scene, name), getattr(made, name))
    told = messages.info(THREE, {"kettle": scene}, "")
    for body, island in (scene.outlines, *(one["outlines"] for one in (told, *told["objects"]))):
        assert np.allclose(np.hypot(*np.transpose(body)), 0.03, atol=1e-4)
        off = np.abs(np.subtract(island, [0.08, 0.0])).max(axis=1)
        assert np.allclose(off, 0.01, atol=1e-4)
    assert scene.reach > 0.08
    assert _reach_m(ObservationModel(scene, THREE, 0.005)) > 0.08 + THREE.radius_m
    assert scenes.build(can(), THREE, 0.05).islands.shape == (0, 64, 2)


def test_the_grid_is_the_distance_to_the_outline() -> None:
    """A box's signed distance has a closed form; the grid differs by its grain alone."""
    scene = scenes.build(box(0.06, 0.16), THREE, 0.04)
    ny, nx = scene.silhouette.shape
    x = scene.origin[0] + scene.cell * np.arange(nx)[None, :]
    y = scene.origin[1] + scene.cell * np.arange(ny)[:, None]
    dx, dy = np.abs(x) - 0.03, np.abs(y) - 0.08
    exact = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)) + np.minimum(np.maximum(dx, dy), 0)
    assert np.abs(scene.silhouette - exact).max() < 2e-5
    assert np.array_equal(scene.slices[0], scene.silhouette)


def test_a_slice_above_the_object_is_far_and_a_skin_above_all_of_it_is_refused() -> None:
    assert (scenes.build(box(0.1, 0.1), THREE, 0.09).slices[-1] == scenes.FAR_M).all()
    refuses("change --height-m", scenes.build, box(0.1, 0.1), THREE, 0.5)


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
    assert "CC BY 4.0" in attribution
    mesh = meshes.load(path)
    assert doubts(mesh, skin, 0.04) == []
    scene = scenes.build(mesh, skin, 0.04)
    assert scene.symmetry == order
    error_mm = grid_errors_mm(scene, mesh, 300)
    assert np.sqrt(np.mean(error_mm**2)) < 0.2
    assert np.quantile(error_mm, 0.99) < 0.6
    assert error_mm.max() < 1.5  # at an edge, under the grid's spacing


def grid_errors_mm(scene: Scene, mesh: trimesh.Trimesh, n: int = 200) -> Floats:
    """How far distances that are looked up beside the object's outlines are off."""
    rng, errors = np.random.default_rng(0), []
    bottom = float(mesh.bounds[0][2]) + 0.04
    for grid, z in zip(scene.slices, scene.heights, strict=True):
        shape = meshes.outline(mesh, bottom + z).shape
        if shape.is_empty:
            continue
        edge = max(shapely.get_parts(shape.boundary), key=shapely.length)
        on = shapely.get_coordinates(edge.interpolate(rng.random(n), normalized=True))
        at = on + rng.uniform(-0.005, 0.005, on.shape)
        found = replace(scene, silhouette=grid).clearance(*at.T)[0]
        errors.append(np.abs(found - meshes.signed_distance(shape, *at.T)))
    return 1e3 * np.concatenate(errors)


def test_a_smooth_solid_is_exact_to_the_grids_curvature() -> None:
    """A bilinear lookup of a distance to a circle of 50 mm errs by cell² / 8 / 43 mm at most."""
    mesh = can()
    assert grid_errors_mm(scenes.build(mesh, THREE, 0.04), mesh).max() < 0.04


def test_walls_that_no_skin_touches_are_no_edge_of_the_grids() -> None:
    """Neither a wall's inside nor a solid inside another one."""
    for mesh in (tube(0.047), trimesh.util.concatenate([can(), handle()])):
        assert grid_errors_mm(scenes.build(mesh, THREE, 0.04), mesh).max() < 1.0


TRIALS = 4
STEP_M = 0.002  # way of the sensor between two scans


def even(friction: float = 0.4) -> Ground:
    """A load that is the same all around the centre."""
    angle = np.arange(16) * np.pi / 8.0
    points = 0.03 * np.column_stack([np.cos(angle), np.sin(angle)])
    return Ground(points, np.full(16, 1.0 / 16.0), friction)


def depth(pose: Poses, sensor: Poses) -> float:
    seen = se2.compose(se2.inverse(sensor), pose)[None]
    return -float(contacts.clearance(MODEL.scene, SKIN.radius_m, seen)[0])


def test_the_object_gives_way_until_friction_holds_it_and_stays_behind_the_sensor() -> None:
    ways_m, depths = [], []
    for seed in range(TRIALS):
        made = World([MODEL], Conditions(robot_m=0.0), seed)
        made.plan("push", 1)
        made.push()
        steps = [made.step(t) for t in np.arange(made.push_s, made.duration_s, 0.05)]
        for before, after in pairwise(steps):
            if depth(before.truth, after.sensor) < DEPTH_M:
                assert np.array_equal(before.truth, after.truth)
        depths += [depth(step.truth, step.sensor) for step in steps]
        gap = se2.compose(se2.inverse(steps[0].truth), steps[-1].truth)
        ways_m.append(np.hypot(gap[0], gap[1]))
        assert ways_m[-1] < STEP_M * len(steps)
        assert ways_m[-1] < made.pushed_m + 0.02
    pressed = np.array(depths)[np.array(depths) > 0.0]
    assert max(depths) < DEPTH_M + 3e-4
    assert np.mean(pressed > DEPTH_M - 3e-4) > 0.5
    assert max(ways_m) > 0.1


def test_an_object_slides_with_the_least_power_that_follows_the_push() -> None:
    """Against a search over all turns, which leave a contact that sticks one choice."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        angle = rng.uniform(-np.pi, np.pi, 16)
        points = rng.uniform(0.0, 0.05, (16, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])
        load = rng.random(16)
        ground = Ground(points, load / load.sum(), 100.0)  # never slips
        contact, wanted = np.array([0.05, rng.uniform(-0.04, 0.04)]), np.array([-0.002, 0.0005])

        def power(
            turn: float, given: Ground = ground, at: Floats = contact, wanted: Floats = wanted
        ) -> float:
            shift = wanted - turn * np.array([-at[1], at[0]])
            x, y = given.points.T
            return float(given.load @ np.hypot(shift[0] - turn * y, shift[1] + turn * x))

        best = optimize.minimize_scalar(power, bounds=(-0.2, 0.2), method="bounded")
        motion = ground.slide(contact, wanted, np.array([-1.0, 0.0]))
        assert power(float(motion[2])) <= power(float(best.x)) * 1.01
        held = motion[:2] + motion[2] * np.array([-contact[1], contact[0]])
        assert np.allclose(held, wanted, atol=1e-9)


def test_a_contact_slips_where_its_friction_is_too_small() -> None:
    contact, wanted = np.array([0.03, 0.0]), np.array([-0.001, 0.002])  # mostly sideways
    inwards = np.array([-1.0, 0.0])
    stuck = even(100.0).slide(contact, wanted, inwards)
    slips = even(0.2).slide(contact, wanted, inwards)
    for motion, holds in ((stuck, True), (slips, False)):
        held = motion[:2] + motion[2] * np.array([-contact[1], contact[0]])
        assert held @ inwards == pytest.approx(0.001)  # it follows all the same
        assert np.allclose(held, wanted) == holds
    assert np.allclose(even(0.0).slide(contact, wanted, inwards), [-0.001, 0.0, 0.0], atol=1e-6)
