"""Touches at a steady pace: the path around the object."""

from functools import lru_cache

import numpy as np
import pytest

from taxeld.arrays import Floats, Poses
from taxeld.model import se2
from taxeld.proposals import bundle
from taxeld_hil.world import touches
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.mesh_skin import MeshSkin
from taxeld_hil.world.touches import TouchPlan
from tests.hil.rig import SKIN, TRUTH

HARD = np.zeros(len(SKIN))


@lru_cache
def skin_of(name: str) -> MeshSkin:
    return MeshSkin(solid_of(name, SKIN), SKIN, 0.002)


def depth_m(name: str, sensor: Poses) -> Floats:
    """(M,) of each taxel, the sensor at a pose (3,) in the world."""
    return skin_of(name).indentation(se2.compose(se2.inverse(sensor), TRUTH), HARD)


@lru_cache
def planned(name: str, seed: int) -> TouchPlan:
    return touches.plan(bundle.load(name, SKIN, 0.005).model, TRUTH, seed, 10)


BOTH = pytest.mark.parametrize("name", ["box", "mug"])


@BOTH
def test_touches_begin_two_to_three_seconds_apart_and_last_about_one(name: str) -> None:
    for seed in range(4):
        plan = planned(name, seed)
        assert len(plan.touches) == 10
        apart = np.diff([touch.begin_s for touch in plan.touches])
        assert (apart >= 1.99).all()
        assert (apart <= 3.01).all()
        lasts = [touch.end_s - touch.begin_s for touch in plan.touches]
        assert all(1.0 < seconds < 1.5 for seconds in lasts)


@BOTH
def test_the_object_is_pressed_in_the_holds_and_not_before_a_touch_begins(name: str) -> None:
    for seed in range(4):
        plan = planned(name, seed)
        for touch in plan.touches:
            assert depth_m(name, plan.path.at(float(np.mean(touch.held_s)))).max() > 2.5e-4
            assert not depth_m(name, plan.path.at(touch.begin_s)).any()
            assert not depth_m(name, plan.path.at(touch.end_s)).any()
