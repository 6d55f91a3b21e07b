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
SEEDS = 4


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


@pytest.mark.parametrize(
    ("given", "is_off"),
    [
        (Conditions(robot_m=0.0), False),
        (Conditions(robot_m=0.002), True),
        (Conditions(moved_m=0.002), True),
    ],
    ids=["exact", "robot", "moved"],
)
def test_touches_that_are_off_are_given_room_and_exact_ones_none(
    given: Conditions, is_off: bool
) -> None:
    found = ends(given)
    assert [(slack > 0.0) == is_off for _, slack in found].count(True) >= SEEDS // 2
    assert [error < 10.0 for error, _ in found].count(True) >= SEEDS // 2
