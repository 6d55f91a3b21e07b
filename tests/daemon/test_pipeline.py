"""Inputs age, wait for one another, and are stamped by a clock that somebody may set."""

import json
import math
import time
from collections.abc import Iterable
from itertools import accumulate, count
from operator import itemgetter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.commands.replay import outcomes, replay
from taxeld.config.file import load, parse
from taxeld.estimator.estimate import Status
from taxeld.model import se2
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome, Pipeline
from taxeld.pipeline.poses import EXTRAPOLATE_S
from taxeld.proposals import choice
from taxeld.proposals.bundle import Bundle
from taxeld.source.recorder import Recorder
from taxeld.source.session import ClockStep, Pass, SensorPose
from taxeld.stream import messages
from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol.decoder import Decoder, Scan
from tests.rig.configurations import configuration
from tests.rig.examples import examples
from tests.rig.recorded import write_session
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.skins import SKIN
from tests.rig.virtual_hub import frames_of, told

CAN = 'kind = "can"\nchannel = "can0"'
CONFIG = '[scene]\nbundle = "box"\n[filter]\nproposal = "manifold"\n'
ROBOT = '[sensor_pose]\nendpoint = "tcp://127.0.0.1:9"\n'
TRUTH = np.array([0.02, -0.03, 0.4])
HOUR_S = 3600.0
LEARNED = 24  # scans until the baseline is there, and some more
START_S = 10_000.0


def pipeline_of(
    box: Bundle, text: str = "", extrapolate_s: float = 0.0, source: str = CAN
) -> Pipeline:
    config = parse(f"[source]\n{source}\n{CONFIG}{text}")
    samples = choice.samples([box], config.filter)
    return Pipeline(config, [SKIN], [box.model], samples, extrapolate_s=extrapolate_s)


def begun(
    box: Bundle, text: str = ROBOT, extrapolate_s: float = 0.0
) -> tuple[Pipeline, SimulatedSkin]:
    """A pipeline with a baseline, and the skin that it is of; the sensor at rest."""
    pipeline, skin = pipeline_of(box, text, extrapolate_s), SimulatedSkin(SKIN, noise=5.0)
    for _ in range(LEARNED):
        scan = skin.scan()
        pipeline.poses.add(scan.t, 0.3, 0.0, 0.0)
        assert len(list(pipeline.advance([scan], scan.t))) == 1
    assert pipeline.estimate.status is Status.SEARCHING
    return pipeline, skin


@pytest.mark.parametrize(
    ("late_s", "counter"),
    [
        (0.51, "scans_old"),
        (HOUR_S, "scans_old"),
        (-0.11, "scans_from_the_future"),
        (-HOUR_S, "scans_from_the_future"),
        (np.nan, "scans_from_the_future"),
    ],
)
def test_a_scan_of_another_time_makes_the_estimate_stale_until_the_next(
    box: Bundle, late_s: float, counter: str
) -> None:
    pipeline, skin = begun(box, "")
    scan = skin.scan()
    (refused,) = pipeline.advance([scan], scan.t + late_s)
    assert refused.estimate.status is Status.STALE
    assert pipeline.freshness.why(refused.estimate) is Why.SCANS_MISTIMED
    assert getattr(pipeline.inputs, counter) == 1
    assert pipeline.skin.counters.scans == LEARNED
    scan = skin.scan()
    (taken,) = pipeline.advance([scan], scan.t + 0.49)
    assert taken.estimate.status is Status.SEARCHING


@pytest.mark.parametrize(
    ("poses", "comes", "x"),
    [
        ([(-0.030, 0.30)], (0.03, 0.31), 0.305),
        ([(-0.150, 0.31)], None, 0.31),
        ([(-0.250, 0.31)], None, None),
        ([(-0.018, 0.30), (-0.008, 0.31)], (), 0.318),
        ([(-0.012, 0.30), (-0.002, 2.31)], (), 2.31),
        ([(-0.005, 0.30), (-0.0049, 0.31)], (0.0, 0.32), 0.32),
        ([(-0.500, 0.30), (-0.021, 0.31)], (0.0, 0.32), 0.32),
        ([(-0.100, 0.30), (-0.090, 0.31)], (0.0, 0.32), 0.32),
    ],
    ids=[
        "between two",
        "the last is young enough",
        "the last is too old",
        "a little after the last",
        "a jump is not gone on from",
        "farther after it than two periods",
        "farther after it than is configured",
        "though its age is no more than the limit",
    ],
)
def test_a_scan_is_placed_by_the_poses_about_it_or_waits_for_one(
    box: Bundle,
    poses: list[tuple[float, float]],
    comes: tuple[float, float] | tuple[()] | None,
    x: float | None,
) -> None:
    """`poses`: times from the scan and x. `comes`: the next; (): none is waited for."""
    pipeline, skin = begun(box, ROBOT, EXTRAPOLATE_S)
    skin.t += 1.0
    scan = skin.scan()
    for t, at in poses:
        pipeline.poses.add(scan.t + t, at, 0.0, 0.0)
    found = list(pipeline.advance([scan], scan.t + 0.001))
    assert len(found) == (comes == ()) == 1 - pipeline.inputs.scans_waited
    found += pipeline.advance([], scan.t + 0.019)
    assert len(found) == (comes == ())
    if comes:
        pipeline.poses.add(scan.t + comes[0], comes[1], 0.0, 0.0)
        found += pipeline.advance([], scan.t + 0.0195)
    found += pipeline.advance([], scan.t + 0.022)
    (outcome,) = found
    assert pipeline.inputs.scans_without_pose == (x is None)
    assert outcome.estimate.status is (Status.STALE if x is None else Status.SEARCHING)
    assert outcome.sensor is None or outcome.sensor == pytest.approx([x, 0.0, 0.0])


def test_scans_keep_their_order_and_what_waits_is_bounded(box: Bundle) -> None:
    pipeline, skin = begun(box, ROBOT + "wait_s = 1\n")
    scans = [skin.scan() for _ in range(100)]
    found: list[Outcome] = []
    for scan in scans:
        found += pipeline.advance([scan], scans[-1].t)  # some are old
    found += pipeline.advance((), math.inf)
    assert len(found) == 100
    times = [o.estimate.t for o in found if o.activation is not None]
    assert times == sorted(times)
    assert pipeline.inputs.scans_old == 89


Event = tuple[float, Scan | tuple[float, float, float, float]]  # arrival, and a scan or a pose


def story(box: Bundle, seconds: float = 4.0) -> list[Event]:
    """A skin that goes to the box, presses it and comes back, with poses at 100 Hz."""
    skin, events = SimulatedSkin(SKIN, noise=5.0), list[Event]()
    ways = ([0.0, 1.0, 1.8, 2.2, 2.6, 4.0], [0.25, 0.25, 0.06, 0.06, 0.2, 0.25])
    for k in range(round(seconds / 0.01)):
        t = START_S + 0.01 * k
        sensor = se2.compose(TRUTH, np.array([np.interp(0.01 * k, *ways), 0.002, 0.1]))
        x, y, theta = (float(v) for v in sensor)
        events.append((t, (t, x, y, theta)))
        if k % 5 == 4:
            skin.t = t - 0.05 - 0.003  # the next scan is of a little before this pose
            seen = se2.compose(se2.inverse(sensor), TRUTH)
            skin.press = 20_000.0 * box.model.activation(seen[None])[0]
            events.append((t + 0.001, skin.scan()))
    return events


def taken(pipeline: Pipeline, events: list[Event]) -> list[Outcome]:
    """What these arrivals led to, but for the scans that still wait."""
    found: list[Outcome] = []
    for arrival, event in events:
        scans = [event] if isinstance(event, Scan) else []
        if not isinstance(event, Scan):
            pipeline.poses.add(*event)
        found += pipeline.advance(scans, arrival)
    return found


def estimates(pipeline: Pipeline, events: list[Event]) -> list[dict[str, object]]:
    """The estimates of these arrivals, as they are published."""
    return published([*taken(pipeline, events), *pipeline.advance((), math.inf)])


def published(found: Iterable[Outcome]) -> list[dict[str, object]]:
    return [
        messages.estimate(o.estimate, names=["box"], seq=k, why=Why.VALID)
        for k, o in enumerate(found)
    ]


@given(
    late_ms=st.integers(0, 12),
    jitter=st.lists(st.floats(0, 0.004), min_size=20, max_size=20),
)
@examples(8)
def test_poses_that_come_a_little_late_change_nothing(
    box: Bundle, late_ms: int, jitter: list[float]
) -> None:
    """While they come within the wait, the bytes are those of poses that come at once."""
    prompt = story(box)
    late, last = list[Event](), 0.0
    for k, (arrival, event) in enumerate(prompt):
        if isinstance(event, Scan):
            late.append((arrival, event))
        else:
            last = max(last, arrival + late_ms / 1000.0 + jitter[k % 20])
            late.append((last, event))
    late.sort(key=lambda pair: pair[0])
    first = estimates(pipeline_of(box, ROBOT), prompt)
    assert first[-1]["contacts"] == 1
    again = estimates(pipeline_of(box, ROBOT), late)
    # the first poses are not there yet when the first scans come
    assert json.dumps(again[8:]) == json.dumps(first[8:])


@pytest.mark.parametrize("by", [HOUR_S, -HOUR_S, 0.5, -0.5])
@pytest.mark.parametrize("at_s", [0.1, 1.7, 2.0, 3.0])
def test_a_clock_that_is_set_costs_nothing_but_the_poses_before(
    box: Bundle, by: float, at_s: float
) -> None:
    events = story(box)
    at = START_S + at_s - 0.005
    pipeline = pipeline_of(box, ROBOT)
    found = taken(pipeline, [event for event in events if event[0] < at])
    pipeline.clock_stepped(by)
    found += taken(pipeline, [(t + by, _later(event, by)) for t, event in events if t >= at])
    found += pipeline.advance((), math.inf)
    assert pipeline.inputs.clock_steps == 1
    assert pipeline.skin.counters.scans == len(found) == 80
    whole = pipeline_of(box, ROBOT)
    same = [*taken(whole, events), *whole.advance((), math.inf)]
    for one, other in zip(found, same, strict=True):
        assert one.estimate.status == other.estimate.status
        assert one.estimate.contacts == other.estimate.contacts
        later = by if other.estimate.t > at else 0.0
        assert one.estimate.t == pytest.approx(other.estimate.t + later, abs=1e-6)
        if one.activation is not None and other.activation is not None:
            assert one.activation.t == one.estimate.t
            assert np.array_equal(one.activation.live, other.activation.live)
            assert one.activation.z == pytest.approx(other.activation.z, abs=1e-9)
    assert found[-1].estimate.map == pytest.approx(same[-1].estimate.map, abs=1e-3)
    state = pipeline.skin.state()
    assert state is not None
    assert state.t == pytest.approx(same[-1].estimate.t, abs=1e-6)


def _later(event: Scan | tuple[float, float, float, float], by: float):  # type: ignore[no-untyped-def]
    if isinstance(event, Scan):
        return Scan(event.t + by, event.ihb, event.counts, event.table, event.table_version)
    return event[0] + by, *event[1:]


strange = st.sampled_from([0.0, 0.0, 0.0, 0.03, -0.03, 0.6, -0.6, 1e4, -1e4, np.nan, np.inf])


@given(
    st.lists(
        st.tuples(st.sampled_from(["scan", "pose", "step", "tare", "reset", "wait"]), strange),
        max_size=60,
    )
)
@examples(40)
def test_whatever_arrives_whenever_is_counted_and_never_raises(
    box: Bundle, arrivals: list[tuple[str, float]]
) -> None:
    pipeline, skin = pipeline_of(box, ROBOT), SimulatedSkin(SKIN)
    sent, found = 0, list[Outcome]()
    for kind, by in arrivals:
        if kind == "scan":
            scan = skin.scan()
            sent += 1
            found += pipeline.advance([_later(scan, by)], scan.t)
        elif kind == "pose":
            pipeline.poses.add(skin.t + by, 0.3, 0.0, by)
        elif kind == "step" and np.isfinite(by):
            pipeline.clock_stepped(by)
            skin.t += by
        elif kind == "tare":
            pipeline.tare()
            assert pipeline.estimate.status is Status.STARTING
        elif kind == "reset":
            pipeline.reset()
        else:
            skin.t += 0.05
            found += pipeline.advance([], skin.t)
        assert np.isfinite(pipeline.estimate.t)
        assert np.isfinite(pipeline.skin.baseline).all()
    found += pipeline.advance((), math.inf)
    assert len(found) == sent
    inputs = pipeline.inputs
    refused = inputs.scans_old + inputs.scans_from_the_future
    assert pipeline.skin.counters.scans == sent - refused


@pytest.mark.parametrize(
    ("late_s", "by"), [(0.0, 0.0), (0.008, 0.0), (0.03, 0.0), (0.0, -0.5), (0.03, HOUR_S)]
)
def test_a_replay_sees_what_the_loop_saw_when_it_saw_it(
    box: Bundle, tmp_path: Path, late_s: float, by: float
) -> None:
    """Poses that come late, and a clock that is set while the skin touches."""
    live, decoder = pipeline_of(box, ROBOT, EXTRAPOLATE_S), Decoder()
    hub, found = VirtualIhb(list(SimulatedSkin(SKIN).modules)), list[Outcome]()
    events = [(t + late_s * (not isinstance(event, Scan)), event) for t, event in story(box)]
    answers, stepped = told(hub), 0.0
    with Recorder(tmp_path, moves=True) as recorder:
        for arrival, event in sorted(events, key=itemgetter(0)):
            t, scans = arrival + stepped, list[Scan]()
            if arrival > START_S + 1.9 and stepped != by:
                recorder.take(ClockStep(t, by))
                live.clock_stepped(by)
                stepped = by
            elif isinstance(event, Scan):
                frames = frames_of([*answers, *hub.sensor_data(list(event.counts))], t=t)
                for frame in frames:
                    recorder.take(frame)
                scans = [scan for _, ended in decoder.take(frames) for scan in ended]
                answers = []
            else:
                pose = event[0] + stepped, *event[1:]
                recorder.take(SensorPose(*pose), 0, t)
                live.poses.add(*pose, t)
            recorder.take(Pass(t))
            found += live.advance(scans, t)
    found += live.advance((), math.inf)
    replayed = pipeline_of(box, ROBOT, EXTRAPOLATE_S)
    again = [*outcomes(tmp_path, replayed)]
    assert published(again) == published(found)
    np.testing.assert_equal([o.sensor for o in again], [o.sensor for o in found])
    assert replayed.health() == live.health()
    assert live.estimate.contacts == 1


def test_a_replay_gives_the_same_bytes_on_a_machine_of_any_speed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_session(tmp_path, touches=2)
    config = load(configuration(tmp_path))
    assert config.filter.proposal == "auto"
    prompt = list(replay(tmp_path, config))
    assert json.loads(prompt[-1])["contacts"] == 2
    hours = accumulate(HOUR_S / k for k in count(1))  # each call an hour, and then less
    for name in ("time", "monotonic", "perf_counter", "process_time", "thread_time"):
        monkeypatch.setattr(time, name, lambda: next(hours))
        monkeypatch.setattr(time, f"{name}_ns", lambda: round(1e9 * next(hours)))
    slow = list(replay(tmp_path, config))
    monkeypatch.undo()
    assert slow == prompt
