"""A daemon that knows three objects says which one it is; the harness holds it to that."""

from dataclasses import replace
from pathlib import Path

import pytest

from taxeld.commands.replay import Replay
from taxeld.estimator.estimate import Status
from taxeld_hil.scenario import scenario

from .rig import passing
from .test_faults import judged

WHICH = scenario.load("which")


@pytest.mark.parametrize(
    ("thing", "name"),
    [("box", "003_cracker_box"), ("mug", "025_mug"), ("drill", "035_power_drill")],
)
def test_each_of_three_objects_is_told_from_the_others_and_its_session_replays_to_it(
    thing: str, name: str, tmp_path: Path
) -> None:
    _, graded = passing(replace(WHICH.touching(thing), contacts=12), tmp_path)
    assert [c.detail for c in graded.checks if c.name == "which object"] == [thing]
    replay = Replay(tmp_path)
    *_, last = replay
    estimate = last.estimate
    assert replay.names[estimate.object] == name
    assert estimate.objects[estimate.object] > 0.99
    assert estimate.status is Status.CONVERGED


def test_an_estimate_of_a_wrong_object_is_misleading_wherever_it_is(tmp_path: Path) -> None:
    right, wrong = (
        judged(tmp_path, [(1.0, Status.CONVERGED, 0.0)], of=WHICH, object=number)
        for number in (2, 0)
    )
    assert right.passed
    assert wrong.failed == ["which object", "nothing misleading"]
    assert wrong.checks[0].detail == "box"
    assert [each.figures["misleading"]["estimates"] for each in (right, wrong)] == [0, 1]


def test_another_object_takes_the_place_of_its_like_among_those_that_are_known() -> None:
    """So that a daemon never has two bundles of one object."""
    demo = scenario.load("demo")
    assert demo.touching("drill").known == ("drill",)
    assert WHICH.touching("mug").known == WHICH.bundles
    assert replace(WHICH, bundles=("box", "mug")).touching("drill").known == ("box", "mug", "drill")
