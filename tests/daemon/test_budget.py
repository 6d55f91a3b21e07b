"""A pass's time, on a clock that is set by hand: what waits, what is saved, and what is counted."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from taxeld.config.file import load, parse
from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Status
from taxeld.layout import read as layouts
from taxeld.model import contacts
from taxeld.pipeline.pipeline import WAITING_MAX, Pipeline
from taxeld.pipeline.warm_up import warm_up
from taxeld.proposals import bundle, choice
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.ladder import Cost, Step
from taxeld.service import health
from taxeld.service.loop import STAGES, Daemon
from taxeld.stream import messages
from taxeld.stream.messages import HEALTH
from tests.daemon.recorded import configuration, write_session
from tests.daemon.simulated_skin import SimulatedSkin

SKIN = layouts.load("cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015")
CONFIG = '[source]\nkind = "replay"\npath = "."\n[scene]\nbundle = "box"\n'


class Clock:
    ns = 1

    def __call__(self) -> int:
        return self.ns


@pytest.fixture(scope="module")
def box() -> Bundle:
    return bundle.load("box", SKIN, 0.005)


def pipeline_of(box: Bundle) -> Pipeline:
    config = parse(CONFIG)
    return Pipeline(config, box.model, choice.ladder(box, config, Clock()))


@pytest.fixture
def begun(box: Bundle) -> tuple[Pipeline, SimulatedSkin]:
    """A pipeline on a clock that stands still, with a baseline, and the skin that it is of."""
    pipeline, skin = pipeline_of(box), SimulatedSkin(SKIN, noise=5.0)
    for _ in range(24):
        scan = skin.scan()
        list(pipeline.advance([scan], scan.t))
    assert pipeline.estimate.status is Status.SEARCHING
    return pipeline, skin


def test_once_a_pass_is_late_one_scan_is_taken_and_the_others_wait(
    begun: tuple[Pipeline, SimulatedSkin],
) -> None:
    pipeline, skin = begun
    scans = [skin.scan() for _ in range(4)]
    pipeline.ends_ns = 0
    taken = [[o.estimate.t for o in pipeline.advance(scans, scans[-1].t)]]
    taken += [[o.estimate.t for o in pipeline.advance((), scans[-1].t)] for _ in range(4)]
    assert taken == [[scan.t] for scan in scans] + [[]]
    assert not pipeline.is_at_work
    pipeline.ends_ns = float("inf")
    scans = [skin.scan() for _ in range(4)]
    assert len(list(pipeline.advance(scans, scans[-1].t))) == 4


def test_of_more_scans_than_can_ever_be_taken_the_oldest_are_let_go_and_counted(
    begun: tuple[Pipeline, SimulatedSkin],
) -> None:
    pipeline, skin = begun
    pipeline.ends_ns = 0
    scans = [skin.scan() for _ in range(WAITING_MAX + 11)]
    now = scans[-1].t
    list(pipeline.advance([scan for scan in scans if now - scan.t < 0.5], now))
    fresh = sum(now - scan.t < 0.5 for scan in scans)
    for scan in scans:  # as if each had only just been sent
        list(pipeline.advance([scan, scan], scan.t))
    inputs = pipeline.inputs
    sent = fresh + 2 * len(scans)
    assert inputs.scans_crowded_out > 0
    assert (
        pipeline.skin.counters.scans
        - 24
        + inputs.scans_crowded_out
        + inputs.scans_old
        + len(pipeline._waiting)
        == sent
    )
    assert len(pipeline._waiting) <= WAITING_MAX


def test_a_touch_without_time_brings_no_sample_and_the_next_with_time_all_of_them(
    begun: tuple[Pipeline, SimulatedSkin], box: Bundle
) -> None:
    pipeline, skin = begun
    pressed = _pressed(box)

    def touch() -> list[int]:
        """Samples that each scan of a touch brings; let go after it."""
        brought = []
        for press in [*3 * [pressed], *6 * [0.0 * pressed]]:
            skin.press = press
            scan = skin.scan()
            brought += [o.estimate.injected for o in pipeline.advance([scan], scan.t)]
        return brought

    pipeline.ladder.deadline_ns = 0
    assert set(touch()) == {0}
    assert pipeline.estimate.contacts == 1
    assert pipeline.ladder.step is Step.NONE
    pipeline.ladder.deadline_ns = float("inf")
    assert max(touch()) >= parse(CONFIG).filter.injected
    assert pipeline.ladder.step is Step.CHOSEN


def test_a_touch_may_take_the_time_until_the_next_scan(
    begun: tuple[Pipeline, SimulatedSkin], box: Bundle
) -> None:
    """However short a pass is; of several hubs each has its share."""
    pipeline, skin = begun
    clock = pipeline.ladder.clock
    assert isinstance(clock, Clock)
    pipeline.degrades, pipeline.ladder.budget_ns = True, float("inf")
    for rung in pipeline.ladder.rungs:
        rung.cost = Cost(30e6)  # each takes 30 ms
    pipeline.ends_ns = clock.ns + 10_000_000

    def touched() -> Step:
        for press in (0.0 * _pressed(box), _pressed(box)):
            for _ in range(4):
                skin.press = press
                scan = skin.scan()
                list(pipeline.advance([scan], scan.t))
        return pipeline.ladder.step

    assert touched() is Step.CHOSEN
    pipeline.skin._last_scans[77] = pipeline.skin._t + 60.0, np.array([], dtype=int)  # another hub
    assert touched() is Step.NONE


def test_to_warm_up_leaves_no_trace_in_the_belief(box: Bundle) -> None:
    found = []
    for warm in (False, True):
        pipeline, skin = pipeline_of(box), SimulatedSkin(SKIN, noise=5.0)
        if warm:
            warm_up(box.model, pipeline.ladder, pipeline.config.filter)
        scans = [skin.scan() for _ in range(8)]
        skin.press = _pressed(box)
        scans += [skin.scan() for _ in range(3)]
        for scan in scans:
            list(pipeline.advance([scan], scan.t))
        estimate = messages.estimate(pipeline.estimate, seq=0, valid=True)
        found.append((json.dumps(estimate), pipeline.ladder.counters.chosen))
    assert found[0] == found[1]


def test_the_ladder_has_cheaper_rungs_below_the_chosen_one_and_ends_without_samples(
    box: Bundle,
) -> None:
    opened = choice.open_all(box, FilterConfig(proposal="ddpm-100"))
    rungs = choice.rungs(box, opened, "ddpm-100", 50)
    steps = [rung.step for rung in rungs]
    assert steps == sorted(steps)
    assert steps[0] is Step.CHOSEN
    assert {Step.CHEAPER, Step.FEWER} < set(steps)
    assert rungs[-1].proposal is None
    costs = [rung.cost.ns for rung in rungs[:2]]
    assert costs[1] < 0.5 * costs[0]


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    write_session(tmp_path)

    tight = "[budget]\n" + "".join(f"{stage}_ms = 0.01\n" for stage in STAGES)
    made = Daemon(load(configuration(tmp_path, tight)))
    yield made
    made.close()


def test_health_is_put_off_while_a_pass_has_no_time_for_it_but_not_for_long(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pass that has worked on a touch is not made longer by it."""
    took_s, sent = 0.0, list[float]()
    now = start = time.monotonic()

    def advance(*_: object) -> list[object]:
        nonlocal clock_ns
        clock_ns += round(1e9 * took_s)
        return []

    clock_ns = time.perf_counter_ns()
    monkeypatch.setattr(time, "perf_counter_ns", lambda: clock_ns)
    monkeypatch.setattr(daemon.pipeline, "advance", advance)
    monkeypatch.setattr(daemon.link, "wants", lambda _: False)
    monkeypatch.setattr(
        daemon.link, "send", lambda topic, *_: sent.append(now) if topic == HEALTH else None
    )
    period_s = 1.0 / daemon.config.loop.rate_hz
    while len(sent) < 4:
        now += period_s
        passed_s = now - start
        took_s = period_s * (0.8 if 1.95 < passed_s < 2.06 or passed_s > 2.5 else 0.2)
        daemon.tick(now)
        assert now < start + 10.0
    apart = np.diff([start + period_s, *sent[1:]])
    assert sent[0] == start + period_s
    assert np.allclose(apart, [1.0, 1.05, 1.1], atol=2.0 * period_s), apart


def test_a_stage_that_takes_longer_than_its_budget_is_counted(daemon: Daemon) -> None:
    start = time.monotonic()
    for k in range(200):
        daemon.tick(start + k * 0.01)
    told = health.of(daemon, 1, start + 2.0, 0.0)
    over = daemon.over_budget
    assert over["source"] > 10
    assert over["publish"] <= told["loop"]["scans"]
    assert over["skin"] <= told["skin"]["scans"]
    assert over["propose"] == 0  # no touch


def _pressed(box: Bundle) -> np.ndarray:
    """Counts over baseline (M,) of a firm touch."""
    rng = np.random.default_rng(0)
    poses = contacts.synthesise(box.model.scene, SKIN.radius_m, 0.005, 200, rng).pose
    z = box.model.activation(poses)
    return np.asarray(20_000.0 * z[np.argmax(z.max(axis=1))])
