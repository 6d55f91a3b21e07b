"""A daemon on a serial skin that is restarted under a touch, and whose clock somebody sets."""

import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from taxeld.config.file import parse
from taxeld.estimator.estimate import Status
from taxeld.layout import read as layouts
from taxeld.service.clock import WallClock
from taxeld.service.loop import Daemon
from taxeld.stream import messages
from tests.daemon.simulated_skin import SimulatedSkin
from tests.virtual_hub import VirtualHub

SPEC = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
DEADLINE_S = 30.0


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


def daemon_of(place: Path, more: str = "") -> Daemon:
    return Daemon(
        parse(
            f'[source]\nkind = "serial"\nchannel = "{place}/skin"\nperiod_ms = 10\n'
            f'[scene]\nbundle = "box"\n[filter]\nproposal = "manifold"\n'
            f'[skin]\nstate_dir = "{place}/state"\n'
            f'[publish]\nendpoints = ["ipc://{place}/stream"]\n[control]\nendpoint = ""\n' + more
        )
    )


def tick(daemon: Daemon, hub: Hub, until: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not until():
        assert time.monotonic() < deadline
        hub.serve(time.monotonic(), lambda _: hub.skin.scan().counts)
        daemon.tick(time.monotonic())
        time.sleep(0.002)


def test_a_restarted_daemon_feels_what_is_held_from_the_first_scan(
    tmp_path: Path, hub: Hub
) -> None:
    first = daemon_of(tmp_path)
    tick(first, hub, lambda: first.pipeline.estimate.status is Status.SEARCHING)
    first.close()
    hub.skin.press[[33, 34]] = 8_000.0
    again = daemon_of(tmp_path)
    tick(again, hub, lambda: again.pipeline.skin.live is not None)
    skin = again.pipeline.skin
    assert skin.touched
    assert np.abs(skin.baseline - hub.skin.base).max() < 100.0
    again.close()


def test_a_scan_is_estimated_when_it_comes_however_slow_the_ticks_are(
    tmp_path: Path, hub: Hub
) -> None:
    """At one tick a second, each of a hundred scans a second has an estimate of its own."""
    daemon = daemon_of(tmp_path, "[loop]\nrate_hz = 1.0\n")
    runs = threading.Thread(target=daemon.run)
    heard: list[dict[str, Any]] = []
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SUBSCRIBE, messages.ESTIMATE)
        socket.connect(f"ipc://{tmp_path}/stream")
        runs.start()
        try:
            deadline = time.monotonic() + DEADLINE_S
            while len(heard) < 60:
                assert time.monotonic() < deadline, f"{len(heard)} scans were estimated"
                hub.serve(time.monotonic(), lambda _: hub.skin.scan().counts)
                if socket.poll(2):
                    estimate = msgpack.unpackb(socket.recv_multipart()[1])
                    heard += [estimate] * (estimate["lat_us"]["filter"] > 0.0)
        finally:
            daemon.stop()
            runs.join(DEADLINE_S)
    assert not runs.is_alive()
    # on a busy machine two scans are read at once, or one is late and an estimate comes without it
    assert all(b["seq"] > a["seq"] for a, b in pairwise(heard))
    gaps = [b["t"] - a["t"] for a, b in pairwise(heard)]
    assert min(gaps) >= 0.0
    assert sorted(gaps)[len(gaps) // 2] < 0.1, "each scan is stamped as it comes"


@pytest.mark.parametrize("by", [3600.0, -3600.0])
def test_a_clock_that_is_set_by_an_hour_leaves_the_daemon_at_work(
    tmp_path: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch, by: float
) -> None:
    real, offset = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + offset[0])
    daemon = daemon_of(tmp_path)
    daemon.clock = WallClock(time.time)
    pipeline = daemon.pipeline
    tick(daemon, hub, lambda: pipeline.estimate.status is Status.SEARCHING)
    offset[0] = by
    taken = pipeline.estimator.counters.scans
    tick(daemon, hub, lambda: pipeline.estimator.counters.scans >= taken + 20)
    assert pipeline.estimate.status is Status.SEARCHING
    assert abs(pipeline.estimate.t - time.time()) < DEADLINE_S
    assert pipeline.inputs.clock_steps == 1
    assert pipeline.inputs.scans_old + pipeline.inputs.scans_from_the_future <= 3
    assert pipeline.estimator.counters.back_in_time == 0
    daemon.close()
