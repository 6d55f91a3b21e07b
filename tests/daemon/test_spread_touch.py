"""A touch whose work goes on over several passes: it leads where the same at once does, whatever
comes in between."""

import json
from typing import NamedTuple

import numpy as np
import pytest

from taxeld.config.file import parse
from taxeld.estimator.estimate import Status
from taxeld.layout import read as layouts
from taxeld.model import contacts
from taxeld.pipeline.outcome import Outcome
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld.proposals.bundle import Bundle
from taxeld.stream import messages
from taxeld_protocol.decoder import Scan
from tests.daemon.simulated_skin import SimulatedSkin

SKIN = layouts.load("cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015")
CONFIG = '[source]\nkind = "replay"\npath = "."\n[scene]\nbundle = "box"\n'
LEARNED = 24  # scans until the baseline is there, and some more


class Clock:
    """Each look at it takes some time."""

    ns, step_ns = 1, 0

    def __call__(self) -> int:
        self.ns += self.step_ns
        return self.ns


@pytest.fixture(scope="module")
def box() -> Bundle:
    return bundle.load("box", SKIN, 0.005)


@pytest.fixture(scope="module")
def scans(box: Bundle) -> list[Scan]:
    """Two touches with silence around them."""
    rng = np.random.default_rng(0)
    poses = contacts.synthesise(box.model.scene, SKIN.radius_m, 0.005, 200, rng).pose
    z = box.model.activation(poses)
    firm = 20_000.0 * z[np.argsort(z.max(axis=1))[[-1, -20]]]
    silent = np.zeros(len(SKIN))
    skin, made = SimulatedSkin(SKIN, noise=5.0), []
    for press in [silent] * LEARNED + [firm[0]] * 4 + [silent] * 6 + [firm[1]] * 4 + [silent] * 3:
        skin.press = press
        made.append(skin.scan())
    return made


def pipeline_of(box: Bundle) -> Pipeline:
    config = parse(CONFIG)
    return Pipeline(config, box.model, choice.ladder(box, config, Clock()))


def late(pipeline: Pipeline) -> Pipeline:
    """Its time for each call is over after a part."""
    pipeline.ends_ns = 0
    return pipeline


class Touched(NamedTuple):
    """A pipeline that is not through with a scan of a touch."""

    pipeline: Pipeline
    scan: Scan
    before: list[Scan]
    after: list[Scan]

    @property
    def clock(self) -> Clock:
        clock = self.pipeline.ladder.clock
        assert isinstance(clock, Clock)
        return clock


@pytest.fixture
def touched(box: Bundle, scans: list[Scan]) -> Touched:
    return begun(box, scans)


def begun(box: Bundle, scans: list[Scan]) -> Touched:
    """With the first scan of a touch that brings samples."""
    pipeline = late(pipeline_of(box))
    for k, scan in enumerate(scans):
        found = list(pipeline.advance([scan], scan.t))
        if pipeline.is_at_work:
            assert k >= LEARNED
            assert found == []
            return Touched(pipeline, scan, scans[:k], scans[k + 1 :])
    raise AssertionError("no work was left")


def through(pipeline: Pipeline, now: float) -> list[Outcome]:
    """All outcomes, in as many calls as there are parts."""
    found: list[Outcome] = []
    calls = 0
    while pipeline.is_at_work:
        found += pipeline.advance((), now)
        calls += 1
        assert calls < 1000
    return found


def as_text(outcomes: list[Outcome]) -> list[str]:
    return [json.dumps(messages.estimate(o.estimate, seq=0, valid=True)) for o in outcomes]


def test_a_spread_touch_leads_where_the_same_at_once_does(box: Bundle, scans: list[Scan]) -> None:
    whole, spread = pipeline_of(box), late(pipeline_of(box))
    at_once, in_parts, parts = list[Outcome](), list[Outcome](), 0
    for scan in scans:
        at_once += whole.advance([scan], scan.t)
        in_parts += spread.advance([scan], scan.t)
        while spread.is_at_work:
            in_parts += spread.advance((), scan.t + 0.001)
            parts += 1
    assert parts > 10, "touches are spread"
    assert at_once[-1].estimate.contacts == 2
    assert as_text(in_parts) == as_text(at_once)
    assert [o.activation is None for o in in_parts] == [o.activation is None for o in at_once]


def test_scans_that_come_meanwhile_wait_their_turn(box: Bundle, touched: Touched) -> None:
    pipeline, others = touched.pipeline, touched.after[:5]
    found = list[Outcome]()
    for scan in others:
        found += pipeline.advance([scan], scan.t)
    found += through(pipeline, others[-1].t)
    assert [o.estimate.t for o in found] == [scan.t for scan in (touched.scan, *others)]
    whole = pipeline_of(box)
    everything = [*touched.before, touched.scan, *others]
    at_once = [o for s in everything for o in whole.advance([s], s.t)]
    assert as_text(found) == as_text(at_once[len(touched.before) :])


def test_until_it_is_through_the_estimate_is_the_one_before(touched: Touched) -> None:
    pipeline, scan = touched.pipeline, touched.scan
    before = pipeline.estimate
    assert before.t == touched.before[-1].t
    (outcome,) = through(pipeline, scan.t)
    assert outcome.is_used
    assert outcome.estimate.injected > 0
    assert pipeline.estimate.t == scan.t


def test_a_reset_forgets_a_touch_that_is_half_done(box: Bundle, touched: Touched) -> None:
    """What follows is as after a reset of one that was through with it."""
    pipeline, scan = touched.pipeline, touched.scan
    pipeline.reset()
    assert pipeline.estimate.contacts == 0
    found = through(pipeline, scan.t)
    assert [o.estimate.contacts for o in found] == [0], "its scan is accounted for"
    pipeline.ends_ns = float("inf")
    rest = touched.after[3:]
    after = [o for s in rest for o in pipeline.advance([s], s.t)]
    whole = pipeline_of(box)
    for s in (*touched.before, scan):
        list(whole.advance([s], s.t))
    whole.reset()
    same = [o for s in rest for o in whole.advance([s], s.t)]
    assert same[-1].estimate.contacts == 1
    assert as_text(after) == as_text(same)


def test_a_tare_lets_a_touch_that_is_half_done_end_while_the_skin_is_learned(
    touched: Touched,
) -> None:
    pipeline = touched.pipeline
    pipeline.tare()
    assert pipeline.estimate.status is Status.STARTING
    (outcome,) = through(pipeline, touched.scan.t)
    assert outcome.estimate.contacts == 1
    assert outcome.estimate.status is Status.STARTING
    assert pipeline.estimate.status is Status.STARTING


@pytest.mark.parametrize("by", [3600.0, -3600.0])
def test_a_clock_that_is_set_meanwhile_dates_its_end(touched: Touched, by: float) -> None:
    pipeline, scan = touched.pipeline, touched.scan
    pipeline.clock_stepped(by)
    (outcome,) = through(pipeline, scan.t + by)
    assert outcome.estimate.t == scan.t + by
    assert outcome.activation is not None
    assert outcome.activation.t == scan.t + by


def test_at_the_end_a_touch_that_is_half_done_is_finished(touched: Touched) -> None:
    (outcome,) = touched.pipeline.flush()
    assert outcome.estimate.t == touched.scan.t
    assert not touched.pipeline.is_at_work


def test_the_time_between_parts_is_nobodys(box: Bundle, scans: list[Scan]) -> None:
    """Neither the filter's nor what the ladder learns of samples."""
    found = []
    for pause_ns in (0, 1_000_000_000):
        touched = begun(box, scans)
        pipeline, clock = touched.pipeline, touched.clock
        clock.step_ns = 1000
        outcomes = list[Outcome]()
        while pipeline.is_at_work:
            clock.ns += pause_ns
            outcomes += pipeline.advance((), touched.scan.t)
        (outcome,) = outcomes
        assert outcome.estimate.injected > 0
        found.append((outcome.filter_ns, outcome.propose_ns, pipeline.ladder._each.ns))
    assert found[0] == found[1]
    assert found[0][0] > 0


def test_a_part_is_begun_only_where_there_is_time_for_it(touched: Touched) -> None:
    """By the longest of late; one is done in each call, whatever it takes."""
    pipeline, clock = touched.pipeline, touched.clock
    clock.step_ns = 1_000_000  # each look at the clock takes a millisecond
    spent = []
    for budget_ns in (0, 12_000_000):
        before = clock.ns
        pipeline.ends_ns = before + budget_ns
        assert list(pipeline.advance((), touched.scan.t)) == []
        spent.append(clock.ns - before)
    assert 0 < spent[0] < spent[1] < 12_000_000 + spent[0]
    pipeline.ends_ns = float("inf")
    assert len(list(pipeline.advance((), touched.scan.t))) == 1
    assert not pipeline.is_at_work


def test_samples_are_drawn_in_a_part_of_their_own(touched: Touched) -> None:
    """Which is long enough without what comes before and after it."""
    pipeline, drawn = touched.pipeline, list[int]()
    learned = pipeline.estimator.rule.memory  # type: ignore[attr-defined]
    before = len(learned)  # silences that told something
    while pipeline.is_at_work:
        drawn.append(pipeline.ladder.counters.chosen)
        if drawn[-1] == 1:
            break
        list(pipeline.advance((), touched.scan.t))
    assert drawn == [0, 1], "not with the first part"
    assert len(learned) == before, "nor with the next"
    parts = len(drawn)
    while pipeline.is_at_work:
        list(pipeline.advance((), touched.scan.t))
        parts += 1
    assert parts >= 7


def test_a_scan_in_which_nothing_is_touched_is_not_spread(box: Bundle, scans: list[Scan]) -> None:
    pipeline = late(pipeline_of(box))
    for scan in scans[:LEARNED]:
        assert len(list(pipeline.advance([scan], scan.t))) == 1
    assert not pipeline.is_at_work


def test_a_scan_that_tells_nothing_new_does_not_wait_for_thoughts_about_what_was_felt(
    box: Bundle, scans: list[Scan]
) -> None:
    """Where estimates are told early. What comes of it in the end is the same."""
    whole, early = pipeline_of(box), pipeline_of(box)
    early.tells_early = True
    told = list[list[Outcome]]()
    for scan in scans:
        found = list(early.advance([scan], scan.t))
        assert len(found) == 1, "the scan's estimate is there"
        assert found[0].estimate is early.estimate
        assert not found[0].is_afterthought
        assert not early.is_at_work
        while early.is_busy:
            found += early.advance((), scan.t)
        told.append(found)
    at_once = [o for scan in scans for o in whole.advance([scan], scan.t)]
    assert as_text([found[-1] for found in told]) == as_text(at_once)
    thought = [found for found in told if len(found) == 2]
    assert len(thought) >= 4
    for first, last in thought:
        assert last.is_afterthought
        assert first.estimate.t == last.estimate.t
        assert first.estimate.injected == 0 < last.estimate.injected
        assert (first.estimate.contact, first.estimate.contacts) == (
            last.estimate.contact,
            last.estimate.contacts,
        )


@pytest.mark.parametrize("lost", ["reset", "tare"])
def test_thoughts_end_with_what_they_are_about(box: Bundle, scans: list[Scan], lost: str) -> None:
    pipeline = pipeline_of(box)
    pipeline.tells_early = True
    for scan in scans:
        list(pipeline.advance([scan], scan.t))
        if pipeline.is_busy:
            break
    assert pipeline.is_busy
    getattr(pipeline, lost)()
    before = pipeline.estimate
    (outcome,) = pipeline.advance((), scan.t)
    assert not pipeline.is_busy
    assert outcome.is_afterthought
    assert outcome.estimate.status is before.status
    if lost == "reset":
        assert outcome.estimate.contacts == outcome.estimate.injected == 0
