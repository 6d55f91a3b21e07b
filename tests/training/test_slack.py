"""A robot that errs, and an object that gives way: the belief learns how exact touches are."""

import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimator import Estimator
from taxeld.model.symmetry import add_m
from taxeld.proposals.analytic import Table
from taxeld_hil.trials.case import Case
from taxeld_hil.trials.play import moments
from taxeld_hil.world.conditions import Conditions
from taxeld_hil.world.subjects import Subject, model_of

BOX = Subject("box")
SEEDS = 6


def ends(given: Conditions) -> list[tuple[float, float]]:
    """Of trials with the box: error [mm] after eight touches, and the scale of the slack."""
    case = Case((BOX,), conditions=given)
    model = model_of(BOX, *case.specs)
    found = []
    for seed in range(SEEDS):
        estimator = Estimator(model, Table(model), FilterConfig(seed=seed), 0.001)
        for moment in moments(case, seed):
            activation, sensor = moment.outcome.activation, moment.outcome.sensor
            if activation is not None and sensor is not None:
                estimate = estimator.on_scan(activation, sensor)
        error = 1e3 * add_m(model.scene, estimate.map, moment.truth)[1]
        found.append((error, estimator.rule.memory.slack.scale))
    return found


def test_touches_that_agree_exactly_are_believed_exactly() -> None:
    assert [slack for _, slack in ends(Conditions(robot_m=0.0))].count(0.0) >= SEEDS // 2


@pytest.mark.parametrize(
    "given", [Conditions(robot_m=0.002), Conditions(moved_m=0.002)], ids=["robot", "moved"]
)
def test_touches_that_are_off_are_given_room_and_the_object_is_found(given: Conditions) -> None:
    found = ends(given)
    assert [slack > 0.0 for _, slack in found].count(True) >= SEEDS // 2
    assert [error < 10.0 for error, _ in found].count(True) >= SEEDS // 2
