"""Trials: one world by two drivers, what each condition changes, and what is noted of a touch."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from taxeld.advice.candidates import PRESS_M, Candidate, way_until_felt
from taxeld.arrays import Floats, Poses
from taxeld.estimator.estimate import Estimate
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.scenario.staged import world_of
from taxeld_sim.trials.case import Case, Method
from taxeld_sim.trials.play import SCAN_S, TICK_S, Direct, play
from taxeld_sim.world import plan, robot
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.subjects import Subject
from taxeld_sim.world.world import AWAY, World
from tests.hil.rig import MODEL, MODULES, SKIN, TRUTH
from tests.rig.commands import refuses
from tests.rig.scenes import disc, scene_of

LINKS = scenario.load("links")
TOUCHES = 6
BOX, MUG = Subject("box"), Subject("mug")


@pytest.mark.parametrize(
    "subject",
    [
        Scenario("box", contacts=3, physics="scene", transport="can"),
        Scenario("box", contacts=3, physics="typical", transport="can", robot_m=0.002),
        Scenario("mug", contacts=2, physics="poor", transport="slcan"),
        replace(LINKS, contacts=4, transport="can"),
    ],
    ids=lambda each: f"{each.physics} {each.transport} {each.links}",
)
def test_both_drivers_give_the_same_estimates_where_the_wire_loses_nothing(
    subject: Scenario,
) -> None:
    """Bit by bit, scan by scan: from the same first scan on, which a hub sends once it has been
    started."""
    run, wired, scans = FakeRun(subject, 5), dict[float, Estimate](), []
    step = run.rig.world.step

    def noted(t: float, link: int = 0) -> Any:
        scans.append(t)
        return step(t, link)

    def told() -> bool:
        """A search may better an estimate."""
        estimate = run.daemon.pipeline.estimate
        wired[round(estimate.t, 6)] = estimate
        return False

    run.rig.world.step = noted  # type: ignore[method-assign]
    run.run(told)
    config = bundle.sized(run.config, [each.manifest for each in run.scenes])
    models = [each.model for each in run.scenes]
    samples = choice.samples(run.scenes, config.filter)
    pipeline = Pipeline(config, [link.layout for link in models[0].links], models, samples)
    direct = Direct(world_of(subject, 5), pipeline, round(scans[0] / TICK_S))
    told_of = {round(o.estimate.t, 6): o.estimate for o in direct.outcomes(run.duration_s)}
    pairs = [(told_of[t], e) for t, e in wired.items() if t in told_of]
    for mine, estimate in pairs:
        np.testing.assert_array_equal(mine.map, estimate.map)
        assert (mine.p, mine.contacts) == (estimate.p, estimate.contacts)
    assert len(pairs) > 15 * (run.duration_s - 3.0)
    assert [*wired.values()][-1].contacts == subject.contacts


def made(
    seed: int = 3, guide: str = "random", model: ObservationModel = MODEL, **given: Any
) -> World:
    """A world of presses of the box."""
    found = World([model], Conditions(**{"robot_m": 0.0} | given), seed)
    found.plan(guide, TOUCHES)
    return found


def kettle() -> ObservationModel:
    """A can, and a handle that stands apart from it at the heights of the taxels."""
    body, grip = disc(0.03), disc(0.01)
    scene = scene_of(lambda x, y: np.minimum(body(x, y), grip(x - 0.1, y)), SKIN, 1)
    return ObservationModel(replace(scene, outline=0.6 * scene.outline), SKIN, 0.005)


def seen(world: World, t: float) -> Poses:
    """The object in the frame of the sensor."""
    return se2.compose(se2.inverse(world.sensor(t)), world.truth_at(t))


def held(world: World) -> Poses:
    """(N, 3) the object in the frame of the sensor while each press is held: in its middle."""
    times = np.arange(0.0, world.duration_s, 0.005)
    gap = gaps(world, times)
    return np.array(
        [
            seen(world, own[gap[(times >= begin) & (times <= end)].argmin()])
            for begin, end in world.touched_s()
            for own in [times[(times >= begin) & (times <= end)]]
        ]
    )


def gaps(world: World, times: Floats) -> Floats:
    """Between the link and the object [m]."""
    poses = np.array([seen(world, t) for t in times])
    return contacts.clearance(world.links[0].scene, SKIN.radius_m, poses)


@pytest.mark.parametrize("guide", ["random", "around"])
@pytest.mark.parametrize(("seed", "model"), [(0, MODEL), (1, MODEL), (2, kettle())])
def test_a_touch_is_one_contact_no_deeper_than_asked_and_the_way_there_is_clear(
    seed: int, model: ObservationModel, guide: str
) -> None:
    world = made(seed, guide, model, press=(0.4, 0.9))
    times = np.arange(0.0, world.duration_s, 0.005)
    gap, touched = gaps(world, times), world.touched_s()
    assert len(touched) == TOUCHES
    within = ((touched[:, :1] <= times) & (times <= touched[:, 1:])).any(axis=0)
    assert gap[~within].min() > 0.004
    pressed = gap < 0.0
    assert np.count_nonzero(np.diff(pressed.astype(int)) == 1) == TOUCHES
    assert -0.0052 < gap.min() < -0.002
    assert max(model.activation(held(world)).max(axis=1)) > plan.TOUCH
    step = np.diff([world.sensor(t)[:2] for t in times], axis=0)
    assert np.linalg.norm(step, axis=1).max() < 0.005 * 0.251


def candidate(beside_m: float, direction: float = 0.4) -> Candidate:
    """Past the middle of the object, at so much to its side."""
    ahead = np.array([np.cos(direction), np.sin(direction)])
    middle = se2.apply(TRUTH, MODEL.scene.centre[None])[0] + beside_m * ahead[::-1] * (-1.0, 1.0)
    (x, y), (x1, y1) = middle - 0.25 * ahead, middle + 0.25 * ahead
    return Candidate(x, y, 1.0, x1, y1)


def told(*candidates: Candidate) -> tuple[World, Floats]:
    """A robot that makes these beside the object; and the times of its way."""
    world = World([MODEL], Conditions(robot_m=0.0), 1)
    world.place(TRUTH)
    world.plan("advised", 0)
    for each in candidates:
        world.touch(each, world.duration_s + 0.2)
    return world, np.arange(0.0, world.duration_s, 0.005)


@pytest.mark.parametrize("direction", np.linspace(-3.0, 3.0, 5))
def test_a_robot_touches_on_a_candidates_straight_way_alone_and_as_deep_as_advice_takes_it(
    direction: float,
) -> None:
    world, times = told(candidate(0.0), last := candidate(0.02, direction))
    gap, touched = gaps(world, times), world.touched_s()
    is_within = ((touched[:, :1] <= times) & (times <= touched[:, 1:])).any(axis=0)
    assert gap[~is_within].min() > 0.5 * robot.SLOW_FROM_M
    pressed = gap < 0.0
    assert np.count_nonzero(np.diff(pressed.astype(int)) == 1) == 2
    assert -PRESS_M - 0.002 < gap.min() < -0.5 * PRESS_M  # a millimetre is felt
    np.testing.assert_allclose(world.sensor(world.duration_s), last.after(np.zeros(1))[0])
    step = np.linalg.norm(np.diff([world.sensor(t)[:2] for t in times], axis=0), axis=1)
    assert step.max() < 0.005 * 1.01 * robot.TRAVEL_M_S
    assert step[pressed[1:]].max() < 0.005 * 1.01 * robot.PRESS_M_S


def test_where_nothing_is_on_a_candidates_way_the_robot_goes_to_its_end_and_back() -> None:
    world, times = told(missed := candidate(0.2))
    assert gaps(world, times).min() > 0.0
    begin, end = missed.after(np.array([0.0, missed.length_m]))
    assert np.linalg.norm(np.array([world.sensor(t) for t in times]) - end, axis=1).min() < 0.002
    np.testing.assert_allclose(world.sensor(world.duration_s), begin)


def test_a_robot_reaches_the_object_from_all_sides_and_begins_clear_of_it() -> None:
    world = World([MODEL], Conditions(), 1)
    world.plan("advised", 0)
    reached, truth = world.reached(), world.truth[None]
    begin = np.concatenate([each.after(np.zeros(1)) for each in reached])
    seen = se2.compose(se2.inverse(begin), truth)
    assert contacts.clearance(MODEL.scene, MODEL.layout.radius_m, seen).min() > 0.02
    ways = np.array([way_until_felt(each, MODEL, truth)[0] for each in reached])
    assert 0.6 < np.isfinite(ways).mean() <= 1.0


@pytest.mark.parametrize(
    "given",
    [
        {"kidnapped_after": 2},
        {"moved_m": 0.02, "moved_rad": 0.1},
        {"nudged_m": 0.002},
        {"dead_share": 0.3},
        {"dead_modules": 2},
        {"stuck": 3},
        {"drift": 0.1},
        {"robot_m": 0.005, "robot_rad": 0.02},
        {"foam": "poor"},
    ],
    ids=lambda given: next(iter(given)),
)
def test_a_condition_leaves_the_touches_of_a_seed_as_they_are(given: dict[str, Any]) -> None:
    np.testing.assert_allclose(held(made()), held(made(**given)), atol=2e-4)


def test_an_object_is_taken_elsewhere_once_moves_along_a_line_or_gives_way_to_each_press() -> None:
    def truths(world: World) -> Poses:
        return np.array([world.truth_at(end) for _, end in world.touched_s()])

    taken = made(kidnapped_after=4)
    off = np.abs(np.diff(truths(taken), axis=0)).max(axis=1)
    assert (off > 0.0).tolist() == [False, False, False, True, False]
    times = np.arange(0.0, taken.duration_s, 0.01)
    carried = [t for t in times if np.array_equal(taken.truth_at(t)[:2], AWAY[:2])]
    assert 0.0 < carried[-1] - carried[0] < 5.0, "while the robot goes to the new place"
    step = np.diff(truths(made(moved_m=0.01, moved_rad=0.1)), axis=0)
    step[:, 2] = se2.wrap(step[:, 2])
    np.testing.assert_allclose(step, np.broadcast_to(step[0], step.shape), atol=1e-9)
    assert np.hypot(*step[0, :2]) == pytest.approx(0.01)
    assert abs(step[0, 2]) == pytest.approx(0.1)
    nudged = made(nudged_m=0.002)
    for (begin, end), (_, before) in zip(
        nudged.touched_s(), [(0.0, 0.0), *nudged.touched_s()], strict=False
    ):
        was, after = nudged.truth_at(before), nudged.truth_at(end)
        assert np.array_equal(was, nudged.truth_at(begin)), "it stands until it is touched"
        assert 0.0004 < np.hypot(*(after - was)[:2]) < 0.006
        assert (after - was)[:2] @ (was - nudged.sensor(end))[:2] > 0.0, "away from the skin"


def test_dead_taxels_read_0_stuck_ones_the_same_and_drift_grows_to_its_size() -> None:
    quiet = {"keys": (("noise_counts", (0.0, 0.0)), ("gain_cv", 0.0))}

    def counts(**given: Any) -> Floats:
        world = made(**quiet, **given)
        return np.array([world.step(t).counts for t in np.arange(0.0, world.duration_s, 0.05)])

    plain, dead = counts(), counts(dead_share=0.25)
    assert (dead == 0).all(axis=0).sum() == len(SKIN) // 4
    assert (dead == 0).any(axis=0).sum() == len(SKIN) // 4
    gone = (counts(dead_modules=2) == 0).all(axis=0).reshape(len(MODULES), -1)
    assert np.count_nonzero(gone.any(axis=1)) == 2
    stuck = counts(stuck=3)
    assert (stuck != plain).any(axis=0).sum() == 3
    np.testing.assert_array_equal(stuck[:30], plain[:30], "before the first touch all work")
    drift = counts(drift=0.1)[-1] - plain[-1].astype(float)
    most = 0.1 / 60.0 * 20_000.0 * 0.05 * (len(plain) - 1)
    assert 0.5 * most < np.abs(drift).max() <= most + 1.0


def test_touches_of_one_side_stay_there() -> None:
    ax, ay = contacts.axis_in_object(held(made(one_side=True)))
    angle = np.arctan2(ay - MODEL.scene.centre[1], ax - MODEL.scene.centre[0])
    assert np.abs(se2.wrap(angle - angle[0])).max() <= 2.0 * plan.SIDE_RAD + 0.3


def test_another_object_stands_beside_and_is_pressed_as_often_as_asked() -> None:
    for seed in range(3):
        world = made(seed, both=2)
        gap = MODEL.scene.clearance(*se2.apply(world.twin, MODEL.scene.edge).T)[0].min()
        assert plan.TWIN_GAP_M - 0.004 < gap <= plan.TWIN_GAP_M
        pressed = MODEL.activation(se2.compose(held(world), world.twin)).max(axis=1) > plan.TOUCH
        assert pressed.sum() == 2


def test_a_press_that_slips_stays_about_its_place() -> None:
    world = made(hold_s=1.0, slip_m=0.001)
    begin = world.touched_s()[0].mean()
    places = world.paths[0].at(begin - 1.5 + np.arange(-0.2, 0.2, 0.01))[:, :2]
    assert 1e-4 < np.ptp(places, axis=0).max() < 0.01


def test_what_cannot_be_touched_or_is_no_name_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "BATCHES_MAX", 0)
    refuses("hardly exist", made)
    for given, said in (
        ({"foam": "wet"}, "no foam 'wet'; there are scene, typical, poor, stiff"),
        ({"keys": (("creep", 1.0),)}, "no key 'creep' of a foam"),
    ):
        refuses(said, Conditions, **given)  # type: ignore[arg-type]
    for key in ("guide", "motion"):
        refuses(f"{key}: no 'x'; there are", Case, (BOX,), **{key: "x"})  # type: ignore[arg-type]
    monkeypatch.undo()
    refuses(
        "003_cracker_box: has no sampler 'density'",
        play,
        Case((Subject("003_cracker_box"),), method=Method("density")),
        0,
    )


def test_a_trial_notes_of_which_object_each_estimate_is_and_how_far_off() -> None:
    found = play(Case((MUG, BOX), BOX), 2)
    assert len(found) == 8
    assert found[-1].named == 1
    assert found[-1].objects[1] > 0.9
    assert found[-1].error_mm < 10.0
    assert all(touch.ms > touch.idle_ms * SCAN_S > 0.0 for touch in found)
    wrong = play(Case((MUG,), BOX, touches=4), 2)
    assert all(math.isnan(touch.error_mm) for touch in wrong)
    assert wrong[-1].p == play(Case((MUG,), BOX, touches=4), 2)[-1].p


@pytest.mark.parametrize(
    "given",
    [
        {"guide": "around"},
        {"guide": "straight"},
        {"guide": "advised"},
        {"layouts": LINKS.layouts[1:] * 2},
    ],
    ids=["around", "straight", "advised", "links"],
)
def test_a_trial_has_a_row_a_touch_by_any_guide(given: dict[str, Any]) -> None:
    found = play(Case((BOX,), touches=3, **given), 1)
    assert len(found) == 3
    assert (found[-1].guide_ms > 0.0) == (given.get("guide") == "advised")
