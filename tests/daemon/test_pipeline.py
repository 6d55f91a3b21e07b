"""Inputs age, wait for one another, and are stamped by a clock that somebody may set."""

import json
from collections import deque
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld import bundle, layout, messages, se2, session
from taxeld.bundle import Bundle
from taxeld.clock import WallClock
from taxeld.config import Config, parse
from taxeld.estimate import Status
from taxeld.pipeline import Outcome, Pipeline, is_valid
from taxeld.poses import BACK_MAX, PoseTrack
from taxeld.replay import outcomes
from taxeld.session import Recorder
from taxeld_protocol import cyskin
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.virtual_ihb import VirtualIhb
from tests.daemon.simulated_skin import SimulatedSkin

SPEC = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
SKIN = layout.load(SPEC)
CONFIG = (
    '[source]\nkind = "replay"\npath = "."\n[scene]\nbundle = "box"\n[filter]\n'
    'proposal = "manifold"\n[skin]\nbaseline_scans = 5\n'
)
ROBOT = '[sensor_pose]\nendpoint = "tcp://127.0.0.1:9"\n'
TRUTH = np.array([0.02, -0.03, 0.4])
HOUR_S = 3600.0
START_S = 10_000.0


@pytest.fixture(scope="module")
def box() -> Bundle:
    return bundle.load("box", SKIN, 0.005)


def config_of(text: str = "") -> Config:
    return parse(CONFIG + text)


def begun(box: Bundle, text: str = ROBOT) -> tuple[Pipeline, SimulatedSkin]:
    """A pipeline with a baseline, and the skin that it is of; the sensor at rest."""
    pipeline, skin = Pipeline(config_of(text), SKIN, box), SimulatedSkin(SKIN, noise=5.0)
    for _ in range(8):
        scan = skin.scan()
        if isinstance(pipeline.poses, PoseTrack):
            pipeline.poses.add(scan.t, 0.3, 0.0, 0.0)
        assert len(list(pipeline.advance([scan], scan.t))) == 1
    assert pipeline.estimate.status is Status.SEARCHING
    return pipeline, skin


@pytest.mark.parametrize(
    ("late_s", "counter"),
    [(0.51, "scans_old"), (HOUR_S, "scans_old"), (-0.11, "scans_from_the_future"),
     (-HOUR_S, "scans_from_the_future"), (np.nan, "scans_from_the_future")],
)  # fmt: skip
def test_a_scan_of_another_time_makes_the_estimate_stale_until_the_next(
    box: Bundle, late_s: float, counter: str
) -> None:
    pipeline, skin = begun(box, "")
    scan = skin.scan()
    (refused,) = pipeline.advance([scan], scan.t + late_s)
    assert refused.estimate.status is Status.STALE
    assert not is_valid(refused.estimate)
    assert getattr(pipeline.inputs, counter) == 1
    assert pipeline.skin.counters.scans == 8
    scan = skin.scan()
    (taken,) = pipeline.advance([scan], scan.t + 0.49)
    assert taken.estimate.status is Status.SEARCHING


def test_a_scan_waits_for_the_pose_at_its_time(box: Bundle) -> None:
    pipeline, skin = begun(box)
    scan = skin.scan()
    assert isinstance(pipeline.poses, PoseTrack)
    pipeline.poses.add(scan.t - 0.01, 0.30, 0.0, 0.0)
    assert list(pipeline.advance([scan], scan.t + 0.001)) == []
    assert list(pipeline.advance([], scan.t + 0.01)) == []
    pipeline.poses.add(scan.t + 0.01, 0.32, 0.0, 0.0)
    (outcome,) = pipeline.advance([], scan.t + 0.012)
    assert outcome.sensor == pytest.approx([0.31, 0.0, 0.0])
    assert pipeline.inputs.scans_waited == 1


@pytest.mark.parametrize(("pose_age_s", "status"), [(0.15, Status.SEARCHING), (0.25, Status.STALE)])
def test_it_does_not_wait_for_ever(box: Bundle, pose_age_s: float, status: Status) -> None:
    """Then the newest pose is used if it is young enough."""
    pipeline, skin = begun(box)
    skin.t += 1.0
    scan = skin.scan()
    pipeline.poses.add(scan.t - pose_age_s, 0.4, 0.0, 0.0)  # type: ignore[union-attr]
    assert list(pipeline.advance([scan], scan.t)) == []
    assert list(pipeline.advance([], scan.t + 0.019)) == []
    (outcome,) = pipeline.advance([], scan.t + 0.021)
    assert outcome.estimate.status is status
    assert pipeline.inputs.scans_without_pose == (status is Status.STALE)


def test_scans_keep_their_order_and_what_waits_is_bounded(box: Bundle) -> None:
    pipeline, skin = begun(box, ROBOT + "wait_s = 1\n")
    scans = [skin.scan() for _ in range(100)]
    found: list[Outcome] = []
    for scan in scans:
        found += pipeline.advance([scan], scans[-1].t)  # some are old
    found += pipeline.flush()
    assert len(found) == 100
    times = [o.estimate.t for o in found if o.activation is not None]
    assert times == sorted(times)
    assert pipeline.inputs.scans_old == 89


def test_without_a_robot_nothing_waits(box: Bundle) -> None:
    pipeline, skin = begun(box, "")
    scan = skin.scan()
    assert len(list(pipeline.advance([scan], scan.t))) == 1


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


def told(pipeline: Pipeline, events: list[Event]) -> list[dict[str, object]]:
    """The estimates of these arrivals, as they are published."""
    found: list[Outcome] = []
    for arrival, event in events:
        scans = [event] if isinstance(event, Scan) else []
        if not isinstance(event, Scan) and isinstance(pipeline.poses, PoseTrack):
            pipeline.poses.add(*event)
        found += pipeline.advance(scans, arrival)
    found += pipeline.flush()
    return published(found)


def published(found: Iterable[Outcome]) -> list[dict[str, object]]:
    return [
        messages.estimate(o.estimate, seq=k, valid=is_valid(o.estimate))
        for k, o in enumerate(found)
    ]


@given(
    late_ms=st.integers(0, 12),
    jitter=st.lists(st.floats(0, 0.004), min_size=20, max_size=20),
)
@settings(max_examples=15, deadline=None)
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
    first = told(Pipeline(config_of(ROBOT), SKIN, box), prompt)
    assert first[-1]["contacts"] == 1
    again = told(Pipeline(config_of(ROBOT), SKIN, box), late)
    # the first poses are not there yet when the first scans come
    assert json.dumps(again[8:]) == json.dumps(first[8:])


@pytest.mark.parametrize("by", [HOUR_S, -HOUR_S, 0.5, -0.5])
@pytest.mark.parametrize("at_s", [0.1, 1.7, 2.0, 3.0])
def test_a_clock_that_is_set_costs_nothing_but_the_poses_before(
    box: Bundle, by: float, at_s: float
) -> None:
    events = story(box)
    at = START_S + at_s - 0.005
    pipeline = Pipeline(config_of(ROBOT), SKIN, box)
    before = [event for event in events if event[0] < at]
    after = [event for event in events if event[0] >= at]
    said = told(pipeline, before)
    pipeline.clock_stepped(by)
    said += told(pipeline, [(t + by, _later(event, by)) for t, event in after])
    assert pipeline.inputs.clock_steps == 1
    assert pipeline.estimator.counters.back_in_time == 0
    assert pipeline.skin.counters.scans == len(said) == 80
    same = told(Pipeline(config_of(ROBOT), SKIN, box), events)
    for one, other in zip(said, same, strict=True):
        assert one["status"] == other["status"]
        assert one["contacts"] == other["contacts"]
    assert said[-1]["map"] == pytest.approx(same[-1]["map"], abs=1e-3)
    assert said[-1]["t"] == pytest.approx(same[-1]["t"] + by)  # type: ignore[operator]


def _later(event: Scan | tuple[float, float, float, float], by: float):  # type: ignore[no-untyped-def]
    if isinstance(event, Scan):
        return Scan(event.t + by, event.ihb, event.counts, event.table, event.table_version)
    return event[0] + by, *event[1:]


def test_scans_that_were_under_way_when_the_clock_was_set_are_not_believed(box: Bundle) -> None:
    pipeline, skin = begun(box, "")
    for by, counter in ((HOUR_S, "scans_old"), (-HOUR_S, "scans_from_the_future")):
        scan = skin.scan()
        pipeline.clock_stepped(by)
        skin.t += by
        (refused,) = pipeline.advance([scan], scan.t + by)
        assert refused.estimate.status is Status.STALE
        assert getattr(pipeline.inputs, counter) == 1
        scan = skin.scan()
        (taken,) = pipeline.advance([scan], scan.t)
        assert taken.estimate.status is Status.SEARCHING


strange = st.sampled_from([0.0, 0.0, 0.0, 0.03, -0.03, 0.6, -0.6, 1e4, -1e4, np.nan, np.inf])


@given(
    st.lists(
        st.tuples(st.sampled_from(["scan", "pose", "step", "tare", "reset", "wait"]), strange),
        max_size=60,
    )
)
@settings(max_examples=40, deadline=None)
def test_whatever_arrives_whenever_is_counted_and_never_raises(
    box: Bundle, arrivals: list[tuple[str, float]]
) -> None:
    pipeline, skin = Pipeline(config_of(ROBOT), SKIN, box), SimulatedSkin(SKIN)
    sent, found = 0, list[Outcome]()
    for kind, by in arrivals:
        if kind == "scan":
            scan = skin.scan()
            sent += 1
            found += pipeline.advance([_later(scan, by)], scan.t)
        elif kind == "pose":
            pipeline.poses.add(skin.t + by, 0.3, 0.0, by)  # type: ignore[union-attr]
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
    found += pipeline.flush()
    assert len(found) == sent
    inputs = pipeline.inputs
    refused = inputs.scans_old + inputs.scans_from_the_future
    assert pipeline.skin.counters.scans == sent - refused


def test_a_pose_that_jumped_is_not_mixed_with_its_neighbours() -> None:
    """Between a right pose and a wrong one lie places that look right and are not."""
    track = PoseTrack(max_age_s=0.2)
    for t, x in ((1.00, 0.3), (1.01, 2.3), (1.02, 0.3)):
        track.add(t, x, 0.0, 0.0)
    placed = [track.at(t) for t in (1.004, 1.006, 1.014, 1.016)]
    assert [pose[0] for pose in placed if pose is not None] == [0.3, 2.3, 2.3, 0.3]


def test_a_robot_whose_clock_is_set_back_is_followed() -> None:
    track = PoseTrack(max_age_s=0.2)
    for k in range(20):
        track.add(1e4 + 0.01 * k, 0.0, 0.0, 0.0)
    for k in range(BACK_MAX):
        assert track.at(500.0 + 0.01 * k) is None
        track.add(500.0 + 0.01 * k, 1.0, 0.0, 0.0)
    assert track.latest_t == pytest.approx(500.0 + 0.01 * (BACK_MAX - 1))
    assert (track.rejected, track.begun_again) == (BACK_MAX - 1, 1)


def test_a_pose_from_far_ahead_does_not_silence_the_robot() -> None:
    track = PoseTrack(max_age_s=0.2)
    track.add(1e9, 0.0, 0.0, 0.0)
    for k in range(BACK_MAX):
        track.add(500.0 + 0.01 * k, 1.0, 0.0, 0.0)
    assert track.at(500.1) is not None


def test_stray_poses_from_the_past_do_not_clear_the_track() -> None:
    track = PoseTrack(max_age_s=0.2)
    for k in range(1000):
        track.add(1000.0 + 0.01 * k, 0.0, 0.0, 0.0)
        track.add(900.0 + 0.01 * k, 1.0, 0.0, 0.0)
    assert track.begun_again == 0
    assert track.rejected == 1000


class Clocks:
    def __init__(self) -> None:
        self.wall, self.monotonic, self.each = 1e9, 50.0, 0.0

    def pass_s(self, seconds: float) -> None:
        self.wall += seconds
        self.monotonic += seconds

    def read_monotonic(self) -> float:
        self.pass_s(self.each)
        return self.monotonic


@pytest.mark.parametrize("by", [HOUR_S, -HOUR_S, 0.3, -0.3])
def test_a_step_of_the_clock_is_seen_once(by: float) -> None:
    clocks = Clocks()
    clock = WallClock(lambda: clocks.wall, clocks.read_monotonic)
    clocks.pass_s(0.01)
    assert clock.read() == (clocks.wall, 0.0)
    clocks.pass_s(0.01)
    clocks.wall += by
    now, seen = clock.read()
    assert now == clocks.wall
    assert seen == pytest.approx(by, abs=1e-5)
    clocks.pass_s(30.0)  # a tick that took long is no step
    assert clock.read()[1] == 0.0
    assert clock.steps == 1


def test_a_clock_that_is_slewed_is_followed_in_silence() -> None:
    clocks = Clocks()
    clock = WallClock(lambda: clocks.wall, clocks.read_monotonic)
    for _ in range(10_000):
        clocks.pass_s(0.01)
        clocks.wall += 0.01 * 500e-6
        assert clock.read()[1] == 0.0
    assert clock.steps == 0


def test_a_reading_in_which_the_process_was_put_aside_tells_nothing() -> None:
    clocks = Clocks()
    clock = WallClock(lambda: clocks.wall, clocks.read_monotonic)
    clocks.each = 1.0  # passes before each reading of the monotonic clock
    assert clock.read()[1] == 0.0
    clocks.each = 0.0
    clocks.wall += HOUR_S
    assert clock.read()[1] == pytest.approx(HOUR_S, abs=1e-5)


def recorded(box: Bundle, place: Path, by: float = 0.0) -> None:
    """The story as a session, with a clock that is set near its middle."""
    hub = VirtualIhb(list(SimulatedSkin(SKIN).modules))
    with Recorder(place, moves=True) as recorder:
        for arrival, event in story(box):
            later = by if arrival > START_S + 1.9 else 0.0
            if isinstance(event, Scan):
                for command, payload in hub.sensor_data(list(event.counts)):
                    for frame in cyskin.to_frames(command, payload, ihb=1, t=arrival + later):
                        recorder.take(frame)
            else:
                recorder.pose(event[0] + later, *event[1:])


@pytest.mark.parametrize("tick_s", [0.004, 0.01, 0.033])
def test_a_replay_gives_the_bytes_of_the_daemon_that_took_the_same_in_ticks(
    box: Bundle, tmp_path: Path, tick_s: float
) -> None:
    recorded(box, tmp_path)
    poses = deque(session.read_poses(tmp_path / session.POSES))
    frames = deque(session.read_frames(tmp_path / session.FRAMES))
    modules = SimulatedSkin(SKIN).modules
    pipeline, decoder = Pipeline(config_of(ROBOT), SKIN, box), Decoder(lambda _: modules)
    live: list[Outcome] = []
    now = START_S
    while frames:
        now += tick_s
        while poses and poses[0][0] <= now:
            pipeline.poses.add(*poses.popleft())  # type: ignore[union-attr]
        scans: list[Scan] = []
        while frames and frames[0].t <= now:
            scans += decoder.feed(frames.popleft())[1]
        live += pipeline.advance(scans, now)
    live += pipeline.flush()
    assert live[-1].estimate.contacts == 1
    again = outcomes(tmp_path, Pipeline(config_of(ROBOT), SKIN, box))
    assert json.dumps(published(live)) == json.dumps(published(again))


@pytest.mark.parametrize("by", [-HOUR_S, -0.5])
def test_a_session_across_a_clock_that_was_set_back_replays(
    box: Bundle, tmp_path: Path, by: float
) -> None:
    recorded(box, tmp_path, by)
    pipeline = Pipeline(config_of(ROBOT), SKIN, box)
    found = list(outcomes(tmp_path, pipeline))
    assert len(found) == 80
    assert pipeline.inputs.clock_steps == 1
    assert pipeline.inputs.scans_without_pose <= 1
    assert pipeline.estimate.contacts == 1
    assert pipeline.estimate.t == pytest.approx(START_S + 4.0 + by, abs=0.1)
