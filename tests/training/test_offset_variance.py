"""A robot that errs, and an object that gives way: the belief learns how exact touches are."""

import pytest

from taxeld.model.symmetry import add_m
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals.analytic import Table
from taxeld.proposals.samples import Samples
from taxeld_sim.trials.case import Case
from taxeld_sim.trials.play import SEEN_S, Direct, world_of
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.subjects import Subject, model_of

BOX = Subject("box")
SEEDS = 4


def ends(given: Conditions) -> list[tuple[float, float]]:
    """Of trials with the box: error [mm] after eight touches, and scale of the offsets."""
    case = Case((BOX,), conditions=given)
    model = model_of(BOX, *case.specs)
    found = []
    for seed in range(SEEDS):
        world = world_of(case, seed)
        pipeline = Pipeline(case.config(seed), [model.layout], [model], Samples([Table(model)]))
        for _ in Direct(world, pipeline).outcomes(world.touched_s()[-1, 1] + SEEN_S):
            pass
        estimator = pipeline.estimator
        error = 1e3 * add_m(model.scene, pipeline.estimate.map, world.truth)[1]
        found.append((error, estimator.belief.memory.offsets.scale))
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
    assert [(scale > 0.0) == is_off for _, scale in found].count(True) >= SEEDS // 2
    assert [error < 10.0 for error, _ in found].count(True) >= SEEDS // 2
