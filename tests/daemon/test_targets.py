"""How many objects are touched, and which touches are of which."""

import numpy as np
import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator import targets
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import Status
from taxeld.estimator.estimator import Estimator
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric
from taxeld.proposals.analytic import Table
from tests.rig.pressed_box import TRUTH, World
from tests.rig.scenes import box, scene_of

FAR = np.array([-0.35, -0.3, 1.1])  # a second object's place
SIDES = (0.2, 1.3, 2.9, 4.5, 3.6, 5.2, 0.7, 2.2)


def model_of(skin: Layout, a: float, b: float) -> Known:
    model = ObservationModel(scene_of(box(a, b), skin, symmetry=2), skin, 0.005)
    return Known(model, Table(model, 4000))


@pytest.fixture(scope="module")
def slab(skin: Layout) -> Known:
    return model_of(skin, 0.03, 0.05)


@pytest.fixture(scope="module")
def stick(skin: Layout) -> Known:
    return model_of(skin, 0.02, 0.1)


def estimator(known: Known, *more: Known, most: int = 2) -> Estimator:
    config = FilterConfig(half_width_m=0.8)
    return Estimator(known.model, known.proposal, config, more=more, most=most)


def touch_in_turn(subject: Estimator, one: World, other: World) -> None:
    """Press two objects from all sides, now one and now the other."""
    other.truth = FAR
    for side in SIDES:
        for world, after in ((one, other), (other, one)):
            world.press(subject, side)
            after.t = world.t


def off_m(known: Known, subject: Estimator, truth: np.ndarray, k: int) -> float:
    """How far the nearest target of object k is from the truth."""
    metric = PoseMetric(known.model.scene)
    of = [target for target in subject.estimate.targets if target.object == k]
    return min(float(metric.distance(target.map, truth)) for target in of)


def test_two_objects_of_one_kind_are_found_and_both_are_sure(slab: Known) -> None:
    subject = estimator(slab)
    touch_in_turn(subject, World(slab.model), World(slab.model))
    found = subject.estimate.targets
    assert [target.status for target in found] == [Status.CONVERGED] * 2
    assert abs(found[0].contacts - found[1].contacts) <= 1
    for truth in (TRUTH, FAR):
        assert off_m(slab, subject, truth, 0) < 0.005


def test_an_object_with_far_fewer_touches_is_found_too(
    slab: Known, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where few poses are paired: some are of its touches."""
    monkeypatch.setattr(targets, "PAIRED", 24)
    subject, one, other = estimator(slab), World(slab.model), World(slab.model)
    other.truth = FAR
    for number, side in enumerate((*SIDES[:6], *SIDES[:6])):
        one.press(subject, side)
        other.t = one.t
        if number % 3 == 2:
            other.press(subject, SIDES[number // 3])
            one.t = other.t
    assert len(subject.estimate.targets) == 2
    for truth in (TRUTH, FAR):
        assert off_m(slab, subject, truth, 0) < 0.02


def test_two_different_objects_are_named(slab: Known, stick: Known) -> None:
    subject = estimator(slab, stick)
    touch_in_turn(subject, World(stick.model), World(slab.model))
    assert [target.object for target in subject.estimate.targets] == [1, 0]
    assert off_m(stick, subject, TRUTH, 1) < 0.005
    assert off_m(slab, subject, FAR, 0) < 0.005


def test_no_more_objects_than_configured_are_looked_for(slab: Known) -> None:
    subject = estimator(slab, most=1)
    touch_in_turn(subject, World(slab.model), World(slab.model))
    assert len(subject.estimate.targets) == 1
    assert subject.estimate.hypotheses.stands < 0.5


def test_one_object_stays_one_even_when_it_is_moved(slab: Known) -> None:
    subject, world = estimator(slab), World(slab.model)
    for side in SIDES[:4]:
        world.press(subject, side)
    world.truth = FAR
    for side in SIDES:
        world.press(subject, side)
    (target,) = subject.estimate.targets
    assert off_m(slab, subject, FAR, 0) < 0.005
    assert target.status is Status.CONVERGED


def test_the_estimate_is_of_the_target_that_was_touched_first(slab: Known) -> None:
    subject = estimator(slab)
    touch_in_turn(subject, World(slab.model), World(slab.model))
    estimate = subject.estimate
    assert np.array_equal(estimate.map, estimate.targets[0].map)
    assert estimate.p == estimate.targets[0].p
    assert PoseMetric(slab.model.scene).distance(estimate.map, TRUTH) < 0.005


def test_a_search_is_made_in_pieces_between_touches(slab: Known) -> None:
    """No piece of it is longer than what one touch takes of one belief."""
    subject, one, other = estimator(slab), World(slab.model), World(slab.model)
    other.truth = FAR
    subject.on_scan = subject.learn  # type: ignore[method-assign]
    pieces = 0
    for side in SIDES:
        for world, after in ((one, other), (other, one)):
            world.press(subject, side)
            after.t = world.t
            while subject.has_thought:
                subject.think()
                pieces += 1
    assert pieces > 40
    assert len(subject.estimate.targets) == 2
