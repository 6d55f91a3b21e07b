"""A daemon on a serial skin that is restarted under a touch, and whose clock somebody sets."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from taxeld.config.file import parse
from taxeld.estimator.estimate import Status
from taxeld.layout import read as layouts
from taxeld.service.clock import WallClock
from taxeld.service.loop import Daemon
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


def daemon_of(place: Path) -> Daemon:
    return Daemon(
        parse(
            f'[source]\nkind = "serial"\nchannel = "{place}/skin"\nperiod_ms = 10\n'
            f'[scene]\nbundle = "box"\n[filter]\nproposal = "manifold"\n'
            f'[skin]\nstate_dir = "{place}/state"\n'
            f'[publish]\nendpoints = ["ipc://{place}/stream"]\n[control]\nendpoint = ""\n'
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
    assert first.kept.counters.saved >= 1
    hub.skin.press[[33, 34]] = 8_000.0
    again = daemon_of(tmp_path)
    assert again.kept.counters.loaded == 1
    tick(again, hub, lambda: again.pipeline.skin.live is not None)
    skin = again.pipeline.skin
    assert skin.counters.states_believed == 1
    assert skin.touched
    assert skin.figures()["begun_again"] == 0
    assert np.abs(skin.baseline - hub.skin.base).max() < 100.0
    again.close()


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
