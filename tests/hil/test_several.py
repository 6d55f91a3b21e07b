"""Scenarios of several links, and of several objects."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands.replay import Replay
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld.pipeline.freshness import Why
from taxeld_hil.grade.session import POSE, read
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Fault
from taxeld_hil.scenario.staged import world_of
from tests.hil.rig import DEMO, passing
from tests.hil.test_faults import judged

pytestmark = pytest.mark.check

LINKS, WHICH = scenario.load("links"), scenario.load("which")


@pytest.mark.parametrize("one_bus", [True, False])
def test_a_session_of_two_links_replays_to_the_object_that_both_have_touched(
    one_bus: bool, tmp_path: Path
) -> None:
    run, _ = passing(replace(LINKS, one_bus=one_bus), tmp_path)
    assert len(run.machine.lines) == 2 - one_bus
    found = list(Replay(tmp_path))
    pressed = {o.link for o in found if o.activation is not None and o.activation.z.max() > 0.1}
    assert pressed == {0, 1}
    assert found[-1].estimate.status is Status.CONVERGED
    last = read(tmp_path, 2).estimates[[*POSE]][-1].tolist()
    np.testing.assert_allclose(found[-1].estimate.map, last, atol=0.01)
    assert found[-1].estimate.contacts == LINKS.contacts


@pytest.mark.smoke
def test_while_one_link_is_silent_the_other_finds_the_object(tmp_path: Path) -> None:
    run = FakeRun(scenario.load("link_silent"), seed=1, rate_hz=40.0)
    (seen,) = run.graded("link_silent", tmp_path).figures["faults"]
    assert seen["detected_s"] is not None
    assert seen["recovered_s"] is not None
    got, (fault,) = read(tmp_path, 2), run.scenario.fault
    gone = got.estimates[(fault.at_s + 1.0 < got.estimates.at) & (got.estimates.at < fault.end_s)]
    during = got._replace(estimates=gone)
    assert not during.lost(0).any()
    assert during.lost(1).all()
    assert np.ptp(gone.contacts) > 0
    assert {*gone.why} <= {Why.VALID, Why.INCONSISTENT}
    assert not got.lost(0)[-1]
    assert not got.lost(1)[-1]


def test_links_touch_one_after_the_other_as_each_would_alone() -> None:
    subject = replace(LINKS, contacts=5, robot_m=0.002)
    both, alone = world_of(subject, 3), world_of(subject.of_link(0), 3)
    assert [len(path.touched) for path in both.paths] == [3, 2]
    times = both.touched_s()
    assert (times[1:, 0] > times[:-1, 1]).all()
    assert all((np.diff(path.t) >= 0.0).all() for path in both.paths)
    one, other = both.paths[0], alone.paths[0]
    for now, before in zip(one.touched, other.touched, strict=True):
        for share in (0.0, 0.4, 1.0):
            at, was = (t[0] + share * (t[1] - t[0]) for t in (now, before))
            np.testing.assert_allclose(one.at(at), other.at(was), atol=1e-9)
            np.testing.assert_allclose(one.stated(at), other.stated(was), atol=1e-9)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"transport": "array"}, "transport: one link at most is an array"),
        ({"transport": "native", "one_bus": True}, "transport: a native line has one hub"),
        ({"contacts": 1}, "contacts: must be at least one for each of 2 links"),
        ({"fault": (Fault("unplugged", 1.0, link=2),)}, "fault.link: the scenario has the links"),
        ({"layouts": ("", ""), "one_bus": True}, "link1 and link2 are on one bus, and both have"),
    ],
)
def test_links_that_do_not_fit_a_scenario_are_refused(keys: dict[str, object], said: str) -> None:
    with pytest.raises(SetupError, match=said):
        FakeRun(replace(LINKS, **keys), 0).run()  # type: ignore[arg-type]


def test_several_layouts_are_links() -> None:
    assert LINKS.on("", "a", "b").layouts == ("a", "b")
    assert LINKS.on("", LINKS.layouts[1]).links == 1
    assert LINKS.on("", "").layouts == LINKS.layouts


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
    assert DEMO.touching("drill").known == ("drill",)
    assert WHICH.touching("mug").known == WHICH.bundles
    assert replace(WHICH, bundles=("box", "mug")).touching("drill").known == ("box", "mug", "drill")
