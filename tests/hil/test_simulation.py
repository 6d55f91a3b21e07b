"""The demo on the fake clock, and the simulated parts it is made of."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld import bundle, contacts, layout, se2
from taxeld.errors import SetupError
from taxeld_hil import robot, scenario
from taxeld_hil.simulate import Simulation, configured, error_by_contact
from taxeld_hil.world import World
from taxeld_protocol.modules import wired

DEMO = scenario.load("demo")
SKIN = layout.load(DEMO.layout)
MODEL = bundle.load(DEMO.bundle, SKIN, 0.005).model
MODULES = wired(SKIN.uid.tolist())


@pytest.mark.parametrize("seed", range(5))
def test_the_demo_finds_the_box(seed: int) -> None:
    errors = error_by_contact(Simulation(DEMO, seed, configured(DEMO, seed)).steps())
    assert len(errors) >= DEMO.contacts  # what a press leaves behind may be felt as one more
    assert errors[-1] < 10.0


def test_the_uninformed_baseline_finds_it_less_often() -> None:
    """What the inverse model is for: at the same cost of particles, projection alone is lost."""
    final = {}
    for proposal in ("auto", "projection"):
        text = f'[filter]\nproposal = "{proposal}"\n'
        final[proposal] = [
            error_by_contact(Simulation(DEMO, seed, configured(DEMO, seed, text)).steps())[3]
            for seed in range(6)
        ]
    assert np.median(final["auto"]) < 0.5 * np.median(final["projection"])


def test_the_robot_touches_as_often_as_asked_and_never_deeper() -> None:
    truth = World(DEMO, MODEL, MODULES, seed=3).truth
    path = robot.plan(DEMO, MODEL, truth, seed=3)
    sensors = np.array([path.at(t) for t in np.arange(0.0, path.duration_s, 0.005)])
    gap = contacts.clearance(MODEL.scene, SKIN.radius_m, se2.compose(se2.inverse(sensors), truth))
    touching = gap < 0.0
    assert np.count_nonzero(np.diff(touching.astype(int)) == 1) == DEMO.contacts
    assert -0.0055 < gap.min() < -DEMO.press_min_m
    step = np.linalg.norm(np.diff(sensors[:, :2], axis=0), axis=1)
    assert step.max() < 0.005 * 1.01 * robot.TRAVEL_M_S


def test_counts_rise_with_pressure_over_a_baseline_of_their_own() -> None:
    world = World(DEMO, MODEL, MODULES, seed=1)
    far = np.array([5.0, 5.0, 0.0])
    idle = np.array([world.counts(far, 0.0) for _ in range(50)])
    assert idle.shape == (50, 88)
    assert 20 < np.median(idle.std(axis=0)) < 50
    path = robot.plan(DEMO, MODEL, world.truth, seed=1)
    pressed = np.array(
        [world.counts(path.at(t), t) for t in np.arange(0.0, path.duration_s, 0.05)]
    ).max(axis=0)
    rise = pressed - idle.mean(axis=0)
    temperature = [0, 11, 22, 33]
    assert rise.max() > 5000
    assert rise[temperature].max() < 2000


def test_a_scenario_that_is_not_there_names_those_that_are() -> None:
    with pytest.raises(SetupError, match=r"no scenario 'party'; shipped are .*demo, "):
        scenario.load("party")


@pytest.mark.parametrize("name", ["box", "mug"])
def test_what_is_out_of_reach_feels_nothing_and_all_else_is_felt(name: str) -> None:
    """The shortcut for the one is no loss to the other: a mug's handle stands off its outline."""
    skin = layout.load(DEMO.layout)
    model = bundle.load(name, skin, 0.005).model
    world = World(replace(DEMO, bundle=name, noise_counts=0.0), model, [], 0)
    rng = np.random.default_rng(0)
    touches = contacts.synthesise(model.scene, skin.radius_m, 0.005, 300, rng).pose
    for seen in touches:
        felt = model.activation(seen[None])[0]
        assert (world._press(seen, 0.0) > 0.0).tolist() == (felt > 0.0).tolist()
