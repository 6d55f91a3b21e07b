"""A robot that errs, and an object that gives way: the belief learns how exact touches are."""

import pytest

from taxeld.model.symmetry import add_m
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals.samples import Samples
from taxeld_hil.trials.case import Case
from taxeld_hil.trials.play import Direct, world_of
from taxeld_hil.world.conditions import Conditions
from taxeld_hil.world.subjects import Subject, model_of

SEEDS = 6


def ends(given: Conditions) -> list[tuple[float, float]]:
    """Of trials with the box: error [mm] after eight touches, and the scale of the slack."""
    case, found = Case((Subject("box"),), conditions=given), []
    model = model_of(case.subject, *case.specs)
    for seed in range(SEEDS):
        samples = Samples(case.proposals())
        direct = Direct(
            world_of(case, seed), Pipeline(case.config(seed), [model.layout], [model], samples)
        )
        for outcome in direct.outcomes(direct.world.duration_s):
            estimate = outcome.estimate
        error = 1e3 * add_m(model.scene, estimate.map, direct.world.truth_at(direct.t))[1]
        found.append((error, direct.pipeline.estimator.rule.memory.slack.scale))
    return found


def test_touches_that_agree_exactly_are_believed_exactly() -> None:
    assert [slack for _, slack in ends(Conditions(robot_m=0.0))].count(0.0) >= SEEDS // 2


@pytest.mark.parametrize(
    "given",
    [Conditions(robot_m=0.002), Conditions(robot_m=0.0, moved_m=0.002)],
    ids=["robot", "moved"],
)
def test_touches_that_are_off_are_given_room_and_the_object_is_found(
    given: Conditions,
) -> None:
    found = ends(given)
    assert [slack > 0.0 for _, slack in found].count(True) >= SEEDS // 2
    assert [error < 10.0 for error, _ in found].count(True) >= SEEDS // 2
