"""Several links touch one object: one belief learns from all of them."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.likelihood import NumpyExplainer
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.model.observation import Activation, ObservationModel
from taxeld.proposals import bundle
from taxeld.proposals.analytic import Table
from tests.rig.pressed_box import TRUTH, World, box_side

RING = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
AWAY = np.array([0.5, 0.0, 0.0])


@pytest.fixture(scope="module")
def model() -> ObservationModel:
    ring = layouts.load(RING)
    return bundle.load("box", ring, further=[ring]).model


def press(subject: Estimator, model: ObservationModel, links: list[int]) -> None:
    """Each link at another side of the box."""
    world = World(model)
    for k, link in enumerate(links):
        world.press(subject, 0.2 + 1.35 * k, link=link)


def subject_of(model: ObservationModel) -> Estimator:
    return Estimator(
        model, Table(model, 4000), FilterConfig(), beside=[Table(model.links[1], 4000)]
    )


def test_touches_of_two_links_find_one_object(model: ObservationModel) -> None:
    """A contact has one number on all links, and a sure belief teaches each link of its own."""
    subject = subject_of(model)
    press(subject, model, [0, 1, 0, 1, 0, 1])
    estimate, memory = subject.estimate, subject.rule.memory
    assert estimate.contacts == 6
    assert estimate.status == Status.CONVERGED
    assert subject.rule.metric.distance(estimate.map, TRUTH) < 0.01
    assert memory.link[memory.contact].tolist() == [0, 1, 0, 1, 0, 1]
    assert memory.number[memory.contact].tolist() == [1, 2, 3, 4, 5, 6]
    lessons = [subject.taught(4, link) for link in (0, 1)]
    assert all(lesson is not None and len(lesson.z) >= 3 for lesson in lessons)
    assert subject.taught(4, 1) is None
    numpy = [NumpyExplainer(each, memory.skin.noise) for each in model.links]
    slow = replace(memory, skin=replace(memory.skin, explainers=numpy))
    poses = subject.rule.belief.pose
    assert np.isclose(slow.explain(poses), memory.explain(poses), atol=0.01).mean() > 0.99


def test_a_link_that_never_touches_changes_nothing(model: ObservationModel) -> None:
    alone = bundle.load("box", model.layout).model
    one = Estimator(alone, Table(alone, 4000), FilterConfig())
    two = subject_of(model)
    press(one, alone, [0] * 4)
    press(two, model, [0] * 4)
    assert np.array_equal(one.estimate.map, two.estimate.map)
    assert one.estimate.p == two.estimate.p


def test_links_of_other_sizes_are_remembered_together() -> None:
    big, small = layouts.load(RING), layouts.load(RING.replace("rows=5", "rows=3"))
    scene = bundle.load("box", big).model.scene
    of_small = ObservationModel(scene, small, 0.005)
    model = ObservationModel(scene, big, 0.005, [of_small])
    subject = subject_of(model)
    press(subject, model, [0, 1, 0, 1, 1, 0])
    assert subject.rule.metric.distance(subject.estimate.map, TRUTH) < 0.01


def test_a_link_that_falls_silent_in_a_touch_touches_nothing_any_more(
    model: ObservationModel,
) -> None:
    subject = subject_of(model)
    seen = box_side(model.links[1], 0.3, 0.003)
    sensor = se2.compose(TRUTH, seen)
    z = model.links[1].activation(se2.inverse(seen)[None])[0]
    live = np.ones(len(z), dtype=np.bool_)
    found = [
        subject.on_scan(Activation(t, pressed * z, live), sensor + away, link).contact
        for t, pressed, away, link in (
            (0.0, 1.0, 0.0, 1),
            (0.05, 1.0, 0.0, 1),
            (0.5, 0.0, AWAY, 0),
            (2.0, 0.0, AWAY, 0),
        )
    ]
    assert found == [True, True, True, False]
