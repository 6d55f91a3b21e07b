"""A robot that errs, and an object that gives way: the belief learns how exact touches are."""

import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layouts
from taxeld.model.symmetry import add_m
from taxeld.proposals import bundle
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.trials import Trial

SKIN = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
SEEDS = 6


def ends(given: TrialConditions) -> list[tuple[float, float]]:
    """Of trials with the box: error [mm] after eight touches, and the scale of the slack."""
    loaded = bundle.load("box", layouts.load(SKIN), 0.005)
    proposal = loaded.proposal("table")
    found = []
    for seed in range(SEEDS):
        estimator = Estimator(loaded.model, proposal, FilterConfig(seed=seed), 0.001)
        for moment in Trial(loaded.model, seed, 8, given):
            estimate = estimator.on_scan(moment.activation, moment.sensor)
        error = 1e3 * add_m(loaded.model.scene, estimate.map, moment.truth)[1]
        found.append((error, estimator.rule.memory.slack.scale))
    return found


def test_touches_that_agree_exactly_are_believed_exactly() -> None:
    assert [slack for _, slack in ends(TrialConditions())].count(0.0) >= SEEDS // 2


@pytest.mark.parametrize(
    "given",
    [TrialConditions(sensor_sd_m=0.002), TrialConditions(pushed_m=0.002)],
    ids=["robot", "moved"],
)
def test_touches_that_are_off_are_given_room_and_the_object_is_found(
    given: TrialConditions,
) -> None:
    found = ends(given)
    assert [slack > 0.0 for _, slack in found].count(True) >= SEEDS // 2
    assert [error < 10.0 for error, _ in found].count(True) >= SEEDS // 2
