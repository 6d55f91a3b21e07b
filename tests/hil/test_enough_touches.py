"""Scenarios touch the object often enough: what is asked of a daemon can be told from touches."""

from functools import lru_cache

import numpy as np
import pytest

from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld_hil.rig.rig import IDLE_S
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Fault, Scenario
from taxeld_hil.world import robot
from taxeld_hil.world.robot import RobotPath
from taxeld_hil.world.world import load_model, make_world
from taxeld_protocol.modules import wired

ENOUGH = 8  # of a mug: fewer may all miss its handle
HARMLESS = ("flooded", "subscriber_dead", "adapter_closed")  # to the scans of a press, or a moment
BEFORE_S, AFTER_S = 0.5, 1.5  # of a hold: the ramp in; and of a fault: to be back
SEEDS = 3


@lru_cache
def model_of(name: str) -> ObservationModel:
    return load_model(scenario.load("demo").touching(name))


def planned(subject: Scenario, seed: int) -> tuple[RobotPath, float, float]:
    """The path, and the object's centre."""
    model = model_of(subject.bundle)
    world = make_world(subject.on("scene"), model, wired(model.layout.uid.tolist()), seed)
    x, y, _ = se2.compose(world.truth, np.array([*model.scene.centre, 0.0]))
    return robot.plan(subject, model, world.truth, seed), x, y


def held_s(path: RobotPath) -> list[tuple[float, float]]:
    """Scenario times at which a press is held, from and to."""
    still = (np.diff(path.pose, axis=0) == 0.0).all(axis=1) & (np.diff(path.t) > 0.0)
    return [(IDLE_S + path.t[i], IDLE_S + path.t[i + 1]) for i in np.flatnonzero(still)]


def spoils(fault: Fault, begin_s: float, end_s: float) -> bool:
    """Whether a press that is held so is not felt as it is, because of a fault."""
    if fault.kind in HARMLESS:
        return False
    gone = fault.kind == "daemon_killed"  # with all that it had felt before
    begun = gone or end_s + BEFORE_S > fault.at_s
    return begun and begin_s - BEFORE_S < fault.end_s + AFTER_S - BEFORE_S


@pytest.mark.parametrize("name", scenario.shipped())
def test_each_scenario_has_eight_presses_that_no_fault_spoils_nor_a_restart_forgets(
    name: str,
) -> None:
    for bundle in ("box", "mug"):
        subject = scenario.load(name).touching(bundle)
        for seed in range(SEEDS):
            holds = held_s(planned(subject, seed)[0])
            assert len(holds) == subject.contacts
            clean = [h for h in holds if not any(spoils(fault, *h) for fault in subject.fault)]
            assert len(clean) >= ENOUGH, (bundle, seed)


@pytest.mark.parametrize("contacts", [5, 8, 20])
def test_any_eight_presses_in_turn_come_from_all_sides(contacts: int) -> None:
    subject = Scenario("mug", contacts=contacts)
    path, x, y = planned(subject, 1)
    at = np.array([path.at(0.5 * sum(hold) - IDLE_S) for hold in held_s(path)])
    side = np.arctan2(at[:, 1] - y, at[:, 0] - x)
    for first in range(max(contacts - ENOUGH, 0) + 1):
        around = np.sort(side[first : first + ENOUGH])
        gaps = np.diff(np.append(around, around[0] + 2.0 * np.pi))
        assert np.degrees(gaps.max()) < 150.0
