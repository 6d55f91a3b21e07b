"""An object that is pushed: the world of the experiment."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import optimize

from taxeld.arrays import Floats, Poses
from taxeld.model import contacts, se2
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.ground import DEPTH_M, Ground
from taxeld_sim.world.world import World

from .rig import MODEL, SKIN

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
    smooth = even(0.0).slide(contact, wanted, inwards)
    assert np.allclose(smooth, [-0.001, 0.0, 0.0], atol=1e-6)
