"""Advice is worked on while nothing else is to do, and is of the present belief alone."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from taxeld.advice.advice import Advice, Approach
from taxeld.config.file import parse
from taxeld.model import se2
from taxeld.pipeline.advising import CALM, MOST, Advising
from taxeld.pipeline.pipeline import Pipeline
from taxeld.prior import PosePrior
from taxeld.proposals import bundle
from taxeld.proposals.bundle import Bundle
from taxeld.service.loop import Daemon
from taxeld.service.publisher import ADVICE_S
from taxeld.service.ticker import Ready
from taxeld.stream import messages
from tests.rig.simulated_skin import SimulatedSkin

from .test_loop import Touches, settings
from .test_pipeline import ROBOT, SKIN, START_S, TRUTH, Event, pipeline_of, published, story, taken

PIECES = 5
AWAY = np.array([1.0, 1.0, 0.0])  # a sensor's pose far from all approaches
ENABLED = "[advice]\nenabled = true\n"


class Adviser:
    """Takes PIECES of work for each advice."""

    def __init__(self, *told: Approach) -> None:
        self.told = told or (approach(),)
        self.begun = self.pieces = 0
        self.advice: Advice | None = None

    def begin(self) -> None:
        self.begun += 1
        self.pieces = 0

    def step(self) -> bool:
        self.pieces += 1
        if self.pieces == PIECES:
            self.advice = Advice(self.begun, self.told, is_enough=False)
        return self.pieces == PIECES


def approach(y: float = 0.1) -> Approach:
    before, at, until = (np.array([x, y, -0.2]) for x in (0.1, 0.2, 0.3))
    return Approach(0, before, at, until, 0.5, 0.003, p_sure=0.6, gain=0.004, p_touch=0.9)


@pytest.fixture(scope="module")
def box() -> Bundle:
    return bundle.load("box", SKIN, 0.005)


def rest(work: Advising) -> None:
    for _ in range(CALM):
        assert not work.has_work
        work.on_scan(AWAY, 0, told=False, moves=False)


def test_it_begins_once_the_belief_rests_and_is_dropped_when_that_changes() -> None:
    adviser = Adviser()
    mount = np.array([0.003, -0.002, 0.1])
    work = Advising(adviser, [mount])  # type: ignore[arg-type]
    rest(work)
    work.step()
    work.on_scan(AWAY, 0, told=False, moves=False)
    assert work.has_work
    work.on_scan(AWAY, 0, told=True, moves=True)
    rest(work)
    for k in range(PIECES):
        assert (adviser.begun, adviser.pieces) == (1 + (k > 0), k or 1)
        assert work.advice is None
        work.step()
    assert work.advice is not None
    (told,) = work.advice.approaches
    for pose, sensor in ((told.before, 0.1), (told.at, 0.2), (told.until, 0.3)):
        assert np.allclose(se2.compose(pose, mount), [sensor, 0.1, -0.2]), "as the robot sends it"
    work.on_scan(AWAY, 0, told=False, moves=False)
    work.step()
    assert (adviser.begun, adviser.pieces, work.has_work) == (2, PIECES, False)
    work.changed()
    assert work.advice is None
    rest(work)


def test_an_approach_that_was_not_felt_is_not_named_again_until_the_belief_has_changed() -> None:
    places = [0.1 * k for k in range(MOST + 2)]
    adviser = Adviser(*map(approach, places))
    work = Advising(adviser, [None])  # type: ignore[arg-type]

    def named() -> list[float]:
        assert work.advice is not None
        return [float(one.at[1]) for one in work.advice.approaches]

    rest(work)
    while work.has_work:
        work.step()
    assert named() == places[:MOST]
    first = adviser.told[0]
    for sensor in (first.before, first.at - np.array([0.02, 0.0, 0.0])):
        work.on_scan(sensor, 0, told=False, moves=True)
    work.on_scan(first.at, 1, told=False, moves=True)  # another link
    assert named() == places[:MOST], "it was not tried yet"
    work.on_scan(first.at + np.array([0.002, 0.0, 0.0]), 0, told=False, moves=True)
    assert named() == places[1 : MOST + 1]
    rest_of_them = adviser.told[1:]
    for one in rest_of_them:
        work.on_scan(one.at, 0, told=False, moves=True)
    assert named() == []
    assert adviser.begun == 1, "the same belief is not thought about twice"
    work.on_scan(AWAY, 0, told=True, moves=True)
    rest(work)
    while work.has_work:
        work.step()
    assert named() == places[:MOST]


def test_silence_that_tells_nothing_keeps_advice_and_silence_that_tells_asks_for_new(
    box: Bundle,
) -> None:
    """A skin that goes past the box, first far from it and then where the belief expects it."""
    pipeline = pipeline_of(box, ROBOT + ENABLED)
    taken(pipeline, story(box, 5.0))
    given = pipeline.advice
    assert given is not None
    skin, t = SimulatedSkin(SKIN, noise=5.0), START_S + 5.0

    def goes(*places: tuple[float, float]) -> None:
        nonlocal t
        for x, y in places:
            t, skin.t = t + 0.05, t
            pipeline.poses.add(t, x, y, 0.5)
            pipeline.poses.add(t + 0.01, x, y, 0.5)
            taken(pipeline, [(t + 0.01, skin.scan())])

    assert pipeline.believing is not None
    counters = pipeline.believing.estimator.counters
    used = counters.updates
    goes(*((0.3 + 0.02 * k, 0.4) for k in range(8)))
    assert counters.updates > used + 5, "it moved"
    assert pipeline.advice is given
    at = given.approaches[0].at
    goes(*((at[0], at[1]) for _ in range(CALM + 2)))
    assert pipeline.advice is not None
    best = pipeline.advice.approaches[0]
    assert not np.allclose(best.before, given.approaches[0].before)


def as_a_daemon_does(pipeline: Pipeline, events: list[Event]) -> None:
    """Thoughts are taken between arrivals, where there is the time."""
    pipeline.thinks_at_once = False
    for event in events:
        taken(pipeline, [event])
        while pipeline.has_thought:
            pipeline.think()


def said(pipeline: Pipeline) -> str:
    assert pipeline.advice is not None
    return json.dumps(messages.advice(pipeline.advice, pipeline.estimate.t, 0, [""]))


def test_a_replay_gives_the_same_advice_and_no_estimate_is_changed_by_it(box: Bundle) -> None:
    events = story(box, 5.0)
    at_once, later, without = (pipeline_of(box, ROBOT + more) for more in (ENABLED, ENABLED, ""))
    assert published(taken(at_once, events)) == published(taken(without, events))
    as_a_daemon_does(later, events)
    assert said(at_once) == said(later)
    assert json.loads(said(later))["contacts"] == 1
    assert without.advice is None


def test_a_belief_that_is_reset_or_told_anew_has_no_advice_yet(box: Bundle) -> None:
    pipeline, events = pipeline_of(box, ROBOT + ENABLED), story(box, 5.0)
    taken(pipeline, events)
    assert pipeline.advice is not None
    x, y, theta = TRUTH.tolist()
    cov = tuple(np.diag([4e-4, 4e-4, 0.04]).ravel().tolist())
    assert pipeline.tell(PosePrior(x, y, theta, cov, 0.9, "")) == ""
    assert pipeline.advice is None
    taken(pipeline, events)
    pipeline.reset()
    assert pipeline.advice is None


@pytest.fixture
def touches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Touches]:
    monkeypatch.setattr("taxeld.pipeline.believing.Advisor", lambda *_: ADVISER)
    daemon = Daemon(parse(settings(tmp_path) + ENABLED))
    yield Touches(daemon, monkeypatch)
    daemon.close()


ADVISER = Adviser()


def test_a_pass_does_one_piece_of_work_and_none_with_a_scan(touches: Touches) -> None:
    heard = touches.heard
    for _ in range(120):
        before = ADVISER.pieces
        touches.tick([touches.next()], Ready(device=True))
        touches.tick([], Ready(device=True))  # frames of the next scan are there
        assert ADVISER.pieces == before
        for _ in range(3):
            before = ADVISER.pieces
            touches.tick([], Ready())
            assert ADVISER.pieces - before in (0, 1, 1 - PIECES)
    told = heard.of(messages.ADVICE)
    assert [*{m["contacts"]: 0 for m in told}] == [1, 2, 3], "each time that it rests"
    assert all(messages.advice_of(m).approaches[0].before[0] == 0.1 for m in told)


def test_advice_that_holds_is_told_again_for_who_comes_later(touches: Touches) -> None:
    while touches.daemon.pipeline.advice is None:
        touches.tick([touches.next()], Ready(device=True))
        touches.tick([], Ready())
    told = len(touches.heard.of(messages.ADVICE))
    touches.now += ADVICE_S
    touches.tick([], Ready())
    touches.tick([], Ready())
    assert len(touches.heard.of(messages.ADVICE)) == told + 1


def test_what_is_told_is_what_was_advised() -> None:
    advice = Advice(3, (approach(),), is_enough=True)
    message = messages.advice(advice, 7.0, 1, ["arm", "wrist"])
    assert message["approaches"][0]["name"] == "arm"
    again = messages.advice_of(message)
    assert (again.contacts, again.is_enough) == (3, True)
    for name in Approach.__slots__:
        assert np.array_equal(getattr(again.approaches[0], name), getattr(approach(), name))
