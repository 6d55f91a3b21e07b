"""The loop on a fake clock, its sockets on real ones, and a whole daemon on a serial skin."""

import contextlib
import itertools
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from taxeld.config.file import parse
from taxeld.estimator import object_belief
from taxeld.estimator.estimate import Status
from taxeld.layout import read as layouts
from taxeld.model.observation import Activation
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome
from taxeld.proposals.samples import Degraded
from taxeld.service import loop
from taxeld.service.clock import Ready
from taxeld.service.loop import GATHERS, Daemon
from taxeld.service.notify import Notifier
from taxeld.stream import messages, topics
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario.scenario import Scenario
from taxeld_protocol.decoder import Scan
from tests.rig.clocks import PATIENCE_S, Clock, until
from tests.rig.configurations import Table, config, served
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.sockets import Sockets
from tests.rig.virtual_hub import VirtualHub


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    made = Daemon(parse(settings(tmp_path)))
    yield made
    made.close()


def settings(place: Path) -> str:
    return (
        f'[source]\nkind = "can"\ninterface = "virtual"\nchannel = "{place.name}"\n'
        f'[scene]\nbundle = "box"\n[publish]\nendpoints = ["ipc://{place}/stream"]\n'
        f'[control]\nendpoint = "ipc://{place}/control"\n'
    )


class Heard(list[tuple[bytes, dict[str, Any]]]):
    """What a daemon sends."""

    def __init__(self, daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(daemon.link, "wants", lambda _: True)
        monkeypatch.setattr(
            daemon.link, "send", lambda topic, message, _: self.append((topic, message))
        )

    def of(self, topic: bytes) -> list[dict[str, Any]]:
        return [message for sent, message in self if sent == topic]


def test_without_scans_estimates_come_at_their_own_rate_and_with_each_change(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard = Heard(daemon, monkeypatch)
    now = time.monotonic()
    daemon.pipeline.freshness.came(now)
    sent = []
    for k in range(100):  # a second, in passes of 10 ms
        daemon.tick(now + 0.01 * k)
        sent.append(len(heard.of(topics.ESTIMATE)))
    estimates = heard.of(topics.ESTIMATE)
    assert 16 <= len(estimates) <= 22  # 20 Hz, in whole passes
    assert [e["seq"] for e in estimates] == list(range(1, len(estimates) + 1))
    statuses = [e["status"] for e in estimates]
    turned = statuses.index(Status.STALE)  # as no scan has come for so long
    assert set(statuses[:turned]) == {Status.STARTING}
    assert sent.index(turned + 1) == 51, "at once"
    daemon.pipeline.tare()
    daemon.pipeline.freshness.came(now + 1.0)
    daemon.tick(now + 1.0001)
    assert heard.of(topics.ESTIMATE)[-1]["status"] == Status.STARTING


class Touches:
    """Scans of a skin that is touched now and then, taken by a daemon whose clock they set."""

    def __init__(self, daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
        self.daemon = daemon
        self.heard = Heard(daemon, monkeypatch)
        self.now = time.monotonic()
        self._skin = SimulatedSkin(daemon.layouts[0], noise=5.0)
        self._skin.t = time.time() - 9.0
        self._made = 0
        monkeypatch.setattr(daemon.around, "unix", lambda: self._skin.t)
        monkeypatch.setattr(object_belief, "SURE", 0.0)  # any belief is to be searched

    def next(self) -> Scan:
        """Another scan."""
        k = self._made
        self._skin.press[[33, 34]] = 8_000.0 * (k % 40 > 30)
        self._skin.press[[55, 56]] = 8_000.0 * (k % 80 > 60)
        self._made += 1
        return self._skin.scan()

    def tick(self, scans: list[Scan], ready: Ready) -> list[dict[str, Any]]:
        """The estimates that a pass sends."""
        before = len(self.heard)
        self.now += 0.002
        self.daemon.tick(self.now, scans, ready)
        return [m for topic, m in self.heard[before:] if topic == topics.ESTIMATE]


@pytest.fixture
def touches(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> Touches:
    return Touches(daemon, monkeypatch)


def test_a_pass_without_arrivals_takes_one_search_and_sends_what_it_bettered(
    touches: Touches,
) -> None:
    daemon, counters = touches.daemon, touches.daemon.pipeline.estimator.counters
    bettered = 0
    for _ in range(120):
        scan = touches.next()
        told = touches.tick([scan], Ready(device=True))
        told += touches.tick([], Ready(device=True))  # frames of the next scan are there
        assert counters.thoughts == bettered
        (first,) = [e for e in told if e["t"] == scan.t]
        told = [e for _ in range(4) for e in touches.tick([], Ready())]
        again = [e for e in told if e["injected"] and not first["injected"]]
        if again:
            bettered += 1
            assert {e["t"] for e in again} == {scan.t}
            assert first["lat_us"]["skin"] > 0.0
            assert again[0]["lat_us"]["skin"] == 0.0
            assert again[0]["lat_us"]["filter"] > 0.0
        assert counters.thoughts == bettered, "one for a scan"
    assert bettered
    assert daemon.publisher.scans == daemon.pipeline.skin.counters.scans, "each scan counts once"


def test_the_status_line_has_p_where_the_estimate_is_valid(daemon: Daemon) -> None:
    now, pipeline = time.monotonic(), daemon.pipeline
    pipeline.freshness.came(now)  # however long the daemon has taken to open
    believed = pipeline.estimator
    believed.estimate = replace(believed.estimate, contacts=2, p=0.5)
    daemon.tick(now)
    assert daemon.publisher.status_line(now) == "starting, not valid, contacts 2, overruns 0"
    pipeline.freshness.links[0].last = Why.VALID
    believed.estimate = replace(believed.estimate, status=Status.CONVERGED, p=0.9962)
    daemon.tick(now)
    assert daemon.publisher.status_line(now) == "converged, p 99.6%, contacts 2, overruns 0"


def test_no_search_is_made_while_a_scan_waits(touches: Touches) -> None:
    pipeline = touches.daemon.pipeline
    for _ in range(200):
        touches.tick([touches.next()], Ready(device=True))
        if pipeline.has_thought:
            break
    assert pipeline.has_thought
    thoughts = pipeline.estimator.counters.thoughts
    pipeline.stages[0].waiting.append((pipeline.estimate.t, touches.next()))
    pipeline.stages[0].is_due = lambda *_: False  # type: ignore[method-assign]  # no pose has come
    touches.tick([], Ready())
    assert not pipeline.has_thought
    assert pipeline.estimator.counters.thoughts == thoughts
    pipeline.stages[0].waiting.clear()
    touches.tick([], Ready())
    assert pipeline.estimator.counters.thoughts == thoughts + 1


SCAN, REST = [Scan(1.0, 1, (), (), 0)], list[Scan]()  # what a look finds: the end, or more to come


@pytest.mark.parametrize(
    ("found", "answered", "looks"),
    [
        ([SCAN], 0, 1),
        ([REST] * 3 + [SCAN], 0, 4),
        ([REST] * 3 + [None], 0, 4),
        ([REST] * 100, 0, GATHERS + 1),
        ([REST, SCAN, None], 3, 3),
        ([SCAN] + [None] * 100, 100, 2),
    ],
    ids=["at once", "one by one", "cut", "without end", "the door is later", "the door is silent"],
)
def test_a_pass_waits_for_all_frames_of_a_scan_and_for_the_doors_answer(
    daemon: Daemon,
    monkeypatch: pytest.MonkeyPatch,
    found: list[list[Scan] | None],
    answered: int,
    looks: int,
) -> None:
    """`found`: at each look scans, their beginnings or nothing; `answered`: looks before the
    door's answer."""
    clock, source, left = Clock(), daemon.inputs.sources[0], iter(found)
    looked = 0

    def poll(_: float) -> list[Scan]:
        nonlocal looked
        looked += 1
        daemon.link.is_asking = looked < answered
        found = next(left)
        source.is_coming = found == REST
        return found or []

    def wait(_: object, __: object, until_s: float) -> None:
        clock.now = until_s

    monkeypatch.setattr(daemon.around, "sleep", lambda _: None)
    monkeypatch.setattr(daemon.around, "monotonic", clock)
    monkeypatch.setattr(daemon.around, "wait", wait)
    monkeypatch.setattr(source, "poll", poll)
    assert len(daemon.take()) == sum(len(each or []) for each in found)
    assert looked == looks


def test_a_pass_whose_own_work_is_longer_than_a_period_is_counted(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    spent_ns = 0

    def advance(*_: object) -> list[Outcome]:
        nonlocal spent_ns
        spent_ns += next(work_ns)
        return []

    work_ns = iter([9_900_000, 10_100_000, 30_000_000, 0])
    monkeypatch.setattr(daemon.pipeline, "advance", advance)
    monkeypatch.setattr(daemon.around, "cpu_ns", lambda: spent_ns)
    counted = []
    for k in range(4):
        daemon.tick(daemon.start_s + 0.01 * k)
        counted.append(daemon.counters.own_overruns)
    assert counted == [0, 1, 2, 2]


def test_what_the_interpreter_leaves_behind_is_collected_once_a_minute(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, began_s, collected = Clock(time.monotonic()), time.monotonic(), list[float]()

    def wait(_: object, __: object, until_s: float) -> Ready:
        clock.now = max(until_s, clock.now + 0.5)
        return Ready()

    monkeypatch.setattr(daemon.around, "monotonic", clock)
    monkeypatch.setattr(daemon.around, "wait", wait)
    monkeypatch.setattr(loop.gc, "collect", lambda: collected.append(clock.now - began_s))
    daemon._loop(Notifier({}), lambda: clock.now > began_s + 150.0)
    assert collected == pytest.approx([0.0, 60.0, 120.0], abs=2.0)


def test_where_touches_take_longer_than_they_have_half_the_samples_are_drawn_and_it_is_said(
    touches: Touches, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    looks_ns = itertools.count(0, 60_000_000)
    monkeypatch.setattr(touches.daemon.around, "cpu_ns", looks_ns.__next__)
    degraded = list[int]()
    for _ in range(300):
        degraded += [e["degraded"] for e in touches.tick([touches.next()], Ready(device=True))]
    assert degraded[0] == Degraded.ALL
    assert degraded == sorted(degraded)
    assert degraded[-1] == Degraded.HALF
    assert any("touches take 60 ms, and have 40" in line for line in caplog.messages)
    touches.daemon.pipeline.reset()
    (estimate,) = touches.tick([touches.next()], Ready(device=True))
    assert estimate["degraded"] == Degraded.ALL


def test_a_robots_mistake_is_named_in_the_answer_to_status(tmp_path: Path) -> None:
    text = settings(tmp_path) + f'[sensor_pose]\nendpoint = "ipc://{tmp_path}/poses"\n'
    with contextlib.closing(Daemon(parse(text))) as daemon, Sockets() as sockets:
        robot = sockets.open(zmq.PUB)
        robot.bind(f"ipc://{tmp_path}/poses")
        good, bad = ({"t": 1.0, "x": 0, "y": 0.5, "theta": theta} for theta in (0.0, 90.0))

        def goes_on() -> None:
            for pose in (good, bad):
                robot.send_multipart([topics.SENSOR_POSE, msgpack.packb(pose), b"1.0"])
            daemon.tick(time.monotonic(), daemon.take())

        fault = "messages come and are no poses: theta is beyond 1.5 turns: send"
        until(lambda: daemon.publisher.state()["sensor_pose"]["fault"].startswith(fault), goes_on)
        assert daemon.pipeline.poses.latest_t == 1.0
        assert daemon.health(time.monotonic(), 1.0)["inputs"]["poses_malformed"] > 0


def test_taxels_say_where_the_sensor_was_or_that_nobody_knows() -> None:
    felt = Activation(5.0, np.array([0.0, 0.5]), np.array([True, True]))
    placed = messages.taxels(felt, np.array([0.1, 0.2, 0.3]), 7)
    assert placed["placed"] is True
    assert placed["sensor"] == {"x": 0.1, "y": 0.2, "theta": 0.3}
    nowhere = messages.taxels(felt, None, 7)
    assert nowhere["placed"] is False
    assert nowhere["sensor"] == {"x": 0.0, "y": 0.0, "theta": 0.0}


SPEC = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"


class Hub(VirtualHub):
    """A hub that sends what a simulated skin reads."""

    def __init__(self, link: Path, skin: SimulatedSkin) -> None:
        super().__init__(link, skin.modules, native=True)
        self.skin = skin


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    made = Hub(tmp_path / "skin", SimulatedSkin(layouts.load(SPEC)))
    yield made
    made.unplug()


def daemon_of(place: Path, **tables: Table) -> Daemon:
    source = {"kind": "serial", "channel": place / "skin", "period_ms": 10}
    skin, proposal = {"state_dir": place / "state"}, {"proposal": "manifold"}
    more = {**served(place), "control": {"endpoint": ""}, **tables}
    return Daemon(config(source=source, skin=skin, filter=proposal, **more))


@pytest.mark.check
def test_a_skin_that_starts_with_the_vendors_pauses_is_not_warned_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    run = FakeRun(Scenario("box", contacts=1, physics="scene"), 0)
    run.run(lambda: run.machine.now > 2.0)
    assert run.daemon.inputs.sources[0].decoder.stats()["scans"] > 0
    assert [line for line in caplog.messages if line.startswith("status: ")] == []


def test_a_scan_is_estimated_when_it_comes_however_slow_the_ticks_are(
    tmp_path: Path, hub: Hub
) -> None:
    """At one tick a second, each of a hundred scans a second has an estimate of its own."""
    daemon = daemon_of(tmp_path, loop={"rate_hz": 1.0})
    stopped = threading.Event()
    runs = threading.Thread(target=daemon.run, args=[stopped.is_set])
    heard: list[dict[str, Any]] = []
    with Sockets() as sockets:
        socket = sockets.subscriber(f"ipc://{tmp_path}/stream", topics.ESTIMATE)

        def listen() -> None:
            hub.serve(time.monotonic(), lambda _: hub.skin.scan().counts)
            while socket.poll(0):
                estimate = msgpack.unpackb(socket.recv_multipart()[1])
                heard.extend([estimate] * (estimate["lat_us"]["filter"] > 0.0))

        runs.start()
        try:
            until(lambda: len(heard) >= 60, listen)
        finally:
            stopped.set()
            runs.join(PATIENCE_S)
    assert not runs.is_alive()
    # on a busy machine two scans are read at once, or one is late and an estimate comes without it
    assert all(b["seq"] > a["seq"] for a, b in pairwise(heard))
    gaps = [b["t"] - a["t"] for a, b in pairwise(heard)]
    assert min(gaps) >= 0.0
    assert sorted(gaps)[len(gaps) // 2] < 0.1, "each scan is stamped as it comes"
