"""Touches at a steady pace: the path, what is counted of a run, and the measurement's memory."""

from dataclasses import asdict, replace
from functools import lru_cache, partial

import numpy as np
import pytest

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.config.toml_tables import Given
from taxeld.estimator.estimator import Estimator
from taxeld.model import se2
from taxeld.model.activation import Activation
from taxeld.proposals import bundle
from taxeld.proposals.analytic import Manifold
from taxeld_hil.experiment import touches as touch_experiment
from taxeld_hil.experiment.touches import AFTER, OVERLOOKED_NATS, TouchRun, truth_nats
from taxeld_hil.scenario.mesh_config import PLAIN
from taxeld_hil.world import touches
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.mesh_skin import MeshSkin
from taxeld_hil.world.touches import Touch, TouchPlan
from tests.hil.rig import DEMO, MODEL, SKIN, TRUTH

TYPICAL = DEMO.on("typical")
HARD = np.zeros(len(SKIN))
OFF = {k: v for k, v in asdict(PLAIN).items() if k not in ("gain_cv", "noise_counts")}


@lru_cache
def skin_of(name: str) -> MeshSkin:
    return MeshSkin(solid_of(name, SKIN), SKIN, 0.002, sags=False)


def depth_m(name: str, sensor: Poses) -> Floats:
    """(M,) of each taxel, the sensor at a pose (3,) in the world."""
    return skin_of(name).indentation(se2.compose(se2.inverse(sensor), TRUTH), HARD)


@lru_cache
def planned(name: str, seed: int) -> TouchPlan:
    model = bundle.load(name, SKIN, 0.005).model
    return touches.plan(model, TRUTH, lambda s: float(depth_m(name, s).max()), seed, 10, 4)


def in_hold(name: str, plan: TouchPlan, touch: Touch) -> Floats:
    return depth_m(name, plan.path.at(float(np.mean(touch.held_s))))


BOTH = pytest.mark.parametrize("name", ["box", "mug"])


@BOTH
def test_touches_begin_two_to_three_seconds_apart_and_last_about_one(name: str) -> None:
    for seed in range(4):
        plan = planned(name, seed)
        presses = [touch for touch in plan.touches if not touch.is_light][:10]
        assert len(presses) == 10
        apart = np.diff([touch.begin_s for touch in presses])
        assert (apart >= 1.99).all()
        assert (apart <= 3.01).all()
        lasts = [touch.end_s - touch.begin_s for touch in presses]
        assert all(1.0 < seconds < 1.5 for seconds in lasts)


@BOTH
def test_the_object_is_pressed_in_the_holds_and_not_before_a_touch_begins(name: str) -> None:
    for seed in range(4):
        plan = planned(name, seed)
        for touch in plan.touches:
            assert in_hold(name, plan, touch).max() > 2.5e-4
            assert not depth_m(name, plan.path.at(touch.begin_s)).any()
            assert not depth_m(name, plan.path.at(touch.end_s)).any()


@BOTH
def test_a_light_touch_comes_within_two_seconds_on_taxels_that_were_pressed(name: str) -> None:
    for seed in range(4):
        plan = planned(name, seed)
        pairs = [k for k, touch in enumerate(plan.touches) if touch.is_light]
        assert len(pairs) == 4
        for k in pairs:
            before, light = plan.touches[k - 1], plan.touches[k]
            deep, faint = in_hold(name, plan, before), in_hold(name, plan, light)
            assert 2.9e-4 < faint.max() < 5.1e-4
            assert deep[faint.argmax()] > faint.max()
            assert light.held_s[0] - before.held_s[1] <= 2.0 + 1e-9


def test_a_skin_that_keeps_nothing_is_felt_when_it_is_touched_and_never_in_the_air() -> None:
    plain = replace(TYPICAL, mesh=Given(OFF))
    found = touch_experiment.play(plain, 0)
    assert found.scans > 400
    assert 0.4 < found.air / found.scans < 0.8
    assert found.felt_in_air == found.missed == 0
    assert found.light == 4
    assert found.contacts == 10
    assert len(found.error_mm) == len(found.converged) == len(AFTER)
    assert found.error_mm[-1] < 5.0


def test_what_is_felt_in_the_air_and_what_is_not_felt_is_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing tells a skin that keeps all of a press from one that is still pressed, nor a light
    touch from noise as large."""
    few = partial(touch_experiment.planned, presses=6)
    monkeypatch.setattr(touch_experiment, "planned", few)
    monkeypatch.setattr(touch_experiment, "PRESSES", 6)
    monkeypatch.setattr(touch_experiment, "AFTER", ())
    keeps = {**OFF, "residue_slow": (0.95, 0.95), "loading_s": 0.05}
    found = touch_experiment.play(replace(TYPICAL, mesh=Given(keeps)), 0)
    assert found.felt_in_air > 0.7 * found.air  # but for those before the first touch
    deaf = {**OFF, "noise_counts": (600.0, 600.0)}
    found = touch_experiment.play(replace(TYPICAL, mesh=Given(deaf)), 0)
    assert found.missed == found.light == 4


def run_of(seed: int, error: float) -> TouchRun:
    return TouchRun(
        "box",
        "poor",
        seed,
        [50.0, error, 20.0, 1.0],
        [False, *[True] * 3],
        [0.5, None, 2.0 * seed, None],
        scans=500,
        air=300,
        felt_in_air=50,
        contacts=10,
        misleading_episodes=seed == 3,
        light=4,
        missed=seed,
    )


def test_the_table_is_of_the_runs() -> None:
    (line,) = list(touch_experiment.lines([asdict(run_of(n, 3.0 * n)) for n in range(4)]))[2:]
    assert line == (
        "| poor, box | 50 (50), 0% | 4.5 (8.1), 50% | 20 (20), 0% | 1 (1), 100% | 4, 2 | 0, 0 "
        "| 10.0% | 38% of 16 | 25.0% |"
    )


def test_a_truth_that_the_filter_has_missed_is_told_from_one_that_touches_do_not_tell() -> None:
    made = Estimator(MODEL, Manifold(MODEL), FilterConfig(injected=20, particles=20))
    touched = touches.plan(MODEL, TRUTH, lambda q: float(depth_m("box", q).max()), 0, 4, 0)
    for k, touch in enumerate(touched.touches):
        sensor = touched.path.at(float(np.mean(touch.held_s)))
        z = MODEL.activation(se2.compose(se2.inverse(sensor), TRUTH)[None])[0]
        made.on_scan(Activation(float(k), z, z >= 0.0), sensor)
    made.estimate = replace(made.estimate, map=TRUTH + np.array([0.05, 0.0, 1.0]))
    assert truth_nats(made, TRUTH) > OVERLOOKED_NATS
    made.estimate = replace(made.estimate, map=TRUTH + np.array([0.002, 0.0, 0.02]))
    assert abs(truth_nats(made, TRUTH)) < OVERLOOKED_NATS
