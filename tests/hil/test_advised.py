"""A virtual robot that follows a daemon's advice."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.advice.advice import Approach
from taxeld.arrays import Floats
from taxeld.model import contacts, se2
from taxeld_hil import cli
from taxeld_hil.world import robot
from taxeld_hil.world.conditions import Conditions
from taxeld_hil.world.world import IDLE_S, World
from tests.rig.commands import refused

from .rig import DEMO, MODEL, SKIN, TRUTH, passing

ADVISED = replace(DEMO, advised=True, contacts=4)
DEPTH_M = 0.003


def approach(beside_m: float, direction: float = 0.4) -> Approach:
    """Past the middle of the object, at so much to its side."""
    ahead = np.array([np.cos(direction), np.sin(direction), 0.0])
    aside = np.array([-ahead[1], ahead[0], 0.0])
    middle = np.array([*se2.compose(TRUTH, np.array([*MODEL.scene.centre, 0.0]))[:2], 1.0])
    before, at, until = (middle + beside_m * aside + way * ahead for way in (-0.25, 0.0, 0.25))
    return Approach(0, before, at, until, direction, DEPTH_M, p_sure=0.5, gain=0.0, p_touch=1.0)


def beside() -> World:
    """A robot that hears advice, beside the object."""
    made = World([MODEL], Conditions(robot_m=0.0), 1)
    made.place(TRUTH)
    made.plan("advised", 0)
    return made


def gap_m(sensors: Floats) -> Floats:
    """Between the link and the object [m]."""
    seen = se2.compose(se2.inverse(sensors), TRUTH)
    return contacts.clearance(MODEL.scene, SKIN.radius_m, seen)


@pytest.mark.parametrize("direction", np.linspace(-3.0, 3.0, 5))
def test_it_touches_on_the_straight_way_alone_and_as_deep_as_advised(direction: float) -> None:
    made = beside()
    made.touch(approach(0.0), IDLE_S + 0.5)
    made.touch(approach(0.02, direction), made.duration_s + 0.2)
    path = made.paths[0]
    times = np.arange(0.0, path.duration_s, 0.005)
    sensors = np.array([path.at(t) for t in times])
    gap, (one, two) = gap_m(sensors), path.touched
    is_within = ((one[0] <= times) & (times <= one[1])) | ((two[0] <= times) & (times <= two[1]))
    assert gap[~is_within].min() > 0.5 * robot.SLOW_FROM_M
    pressed = gap < 0.0
    assert np.count_nonzero(np.diff(pressed.astype(int)) == 1) == 2
    assert -DEPTH_M - 0.002 < gap.min() < -0.5 * DEPTH_M  # a millimetre is felt
    assert np.allclose(path.at(path.duration_s), approach(0.02, direction).before)
    step = np.linalg.norm(np.diff(sensors[:, :2], axis=0), axis=1)
    assert step.max() < 0.005 * 1.01 * robot.TRAVEL_M_S
    assert step[pressed[1:]].max() < 0.005 * 1.01 * robot.PRESS_M_S


def test_where_there_is_nothing_it_goes_to_the_end_and_back() -> None:
    made, missed = beside(), approach(0.2)
    made.touch(missed, IDLE_S + 0.5)
    path = made.paths[0]
    sensors = np.array([path.at(t) for t in np.arange(0.0, path.duration_s, 0.005)])
    assert gap_m(sensors).min() > 0.0
    assert np.linalg.norm(sensors - missed.until, axis=1).min() < 0.002
    assert np.allclose(path.at(path.duration_s), missed.before)


@pytest.mark.check
def test_few_touches_find_the_object(tmp_path: Path) -> None:
    run, _ = passing(ADVISED, tmp_path)
    assert len(run.rig.world.paths[0].touched) <= ADVISED.contacts


def test_in_real_time_no_robot_is_advised(tmp_path: Path) -> None:
    why = "advised: such a robot runs on the fake clock alone: --clock fake\n"
    assert refused("run", "demo", "--advised", "--target", "can:can0", main=cli.main) == why
    scenario = tmp_path / "advised.toml"
    scenario.write_text('bundle = "box"\nadvised = true\n', encoding="utf-8")
    given = ("--can", "vcan0", "--poses", "ipc:///x", "--out", tmp_path / "out")
    assert refused("emulate", scenario, *given, main=cli.main) == why
