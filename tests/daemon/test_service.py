"""A daemon on a serial skin that is restarted under a touch, and whose clock somebody sets."""

import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgpack
import pytest

from taxeld.layout import read as layouts
from taxeld.service.loop import Daemon
from taxeld.source.recorder import Recorder
from taxeld.stream import topics
from tests.rig.clocks import PATIENCE_S, until
from tests.rig.configurations import Table, config, served
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.sockets import Sockets
from tests.rig.virtual_hub import VirtualHub

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


def daemon_of(place: Path, recorder: Recorder | None = None, **tables: Table) -> Daemon:
    source = {"kind": "serial", "channel": place / "skin", "period_ms": 10}
    skin, proposal = {"state_dir": place / "state"}, {"proposal": "manifold"}
    more = {**served(place), "control": {"endpoint": ""}, **tables}
    return Daemon(config(source=source, skin=skin, filter=proposal, **more), recorder)


def tick(daemon: Daemon, hub: Hub, holds: Callable[[], bool]) -> None:
    def tick_once() -> None:
        hub.serve(time.monotonic(), lambda _: hub.skin.scan().counts)
        daemon.tick(time.monotonic())

    until(holds, tick_once)


@pytest.mark.check
def test_a_skin_that_starts_with_the_vendors_pauses_is_not_warned_of(
    tmp_path: Path, hub: Hub, caplog: pytest.LogCaptureFixture
) -> None:
    daemon = daemon_of(tmp_path)

    def between() -> None:
        hub.serve(time.monotonic(), lambda _: hub.skin.scan().counts)
        daemon.stopping = hub.scans > 20

    daemon.run(between)
    assert [line for line in caplog.messages if line.startswith("status: ")] == []


def test_a_scan_is_estimated_when_it_comes_however_slow_the_ticks_are(
    tmp_path: Path, hub: Hub
) -> None:
    """At one tick a second, each of a hundred scans a second has an estimate of its own."""
    daemon = daemon_of(tmp_path, loop={"rate_hz": 1.0})
    runs = threading.Thread(target=daemon.run)
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
            daemon.stop()
            runs.join(PATIENCE_S)
    assert not runs.is_alive()
    # on a busy machine two scans are read at once, or one is late and an estimate comes without it
    assert all(b["seq"] > a["seq"] for a, b in pairwise(heard))
    gaps = [b["t"] - a["t"] for a, b in pairwise(heard)]
    assert min(gaps) >= 0.0
    assert sorted(gaps)[len(gaps) // 2] < 0.1, "each scan is stamped as it comes"
