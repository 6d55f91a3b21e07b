"""Faults of honest life on a daemon as a process: no scan is lost, and its recording tells all."""

import contextlib
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from tests.rig.clocks import PATIENCE_S
from tests.system.touched import Touched, touched

pytestmark = pytest.mark.check

LOSSES = 2
NEAR = 1e-6  # a recording keeps the microseconds of a scan's time, and no less


class Heard:
    """Estimates that a subscriber heard."""

    def __init__(self, endpoint: str) -> None:
        self._opened = contextlib.ExitStack()
        context = self._opened.enter_context(zmq.Context())
        self._socket = self._opened.enter_context(context.socket(zmq.SUB))
        self._socket.linger = 0
        self._socket.subscribe(b"/taxeld/estimate")
        self._socket.connect(endpoint)
        self.estimates: list[dict[str, Any]] = []

    def listen(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0.0:
            if self._socket.poll(1000.0 * left_s):
                self.estimates.append(msgpack.unpackb(self._socket.recv_multipart()[1]))

    def last_of_scans(self) -> Iterator[dict[str, Any]]:
        """Of each scan the last estimate, where it is certain that no later one was missed."""
        for one, following in zip(self.estimates, self.estimates[1:], strict=False):
            if following["seq"] == one["seq"] + 1 and following["t"] != one["t"]:
                yield one

    def close(self) -> None:
        self._opened.close()


@contextlib.contextmanager
def heard(daemon: Touched) -> Iterator[Heard]:
    with contextlib.closing(Heard(daemon.stream)) as made:
        yield made


def check_replayed(heard: Heard, replayed: list[dict[str, Any]]) -> int:
    """What was heard is what the recording replays to; → of how many scans."""
    by_time = {round(1e6 * estimate["t"]): estimate for estimate in replayed}
    last = [e for e in heard.last_of_scans() if round(1e6 * e["t"]) in by_time]
    for told in last:
        again = by_time[round(1e6 * told["t"])]
        assert told["contacts"] == again["contacts"]
        for pose in ("map", "mean"):
            assert told[pose] == pytest.approx(again[pose], abs=NEAR)
        assert told["ess"] == pytest.approx(again["ess"], rel=NEAR)
    return len(last)


def test_a_door_that_is_killed_each_second_costs_no_scan_and_no_record(tmp_path: Path) -> None:
    with touched(tmp_path) as daemon, heard(daemon) as subscriber:
        daemon.until_touched()
        for _ in range(4):
            daemon.kill_door()
            subscriber.listen(1.0)
        health = daemon.health()
        sent = daemon.stop()
        replayed = daemon.replay()
    assert health["door"]["starts"] > 2
    assert len(replayed) == sent > 80
    assert check_replayed(subscriber, replayed) > 10
    assert "cut" not in daemon.log


def test_a_device_that_goes_each_second_is_opened_again(tmp_path: Path) -> None:
    with touched(tmp_path) as daemon, heard(daemon) as subscriber:
        daemon.until_touched()
        door = daemon.door()
        for _ in range(LOSSES):
            daemon.tell_skin("unplug")
            subscriber.listen(0.2)
            daemon.tell_skin("plug")
            subscriber.listen(1.0)
        health = daemon.health()
        assert daemon.door() == door
        daemon.stop(whole=False)
        replayed = daemon.replay()
    assert health["source"]["lost"] == LOSSES
    assert health["door"]["starts"] == 1
    assert check_replayed(subscriber, replayed) > 10


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of its own; only root may have one."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(place)]
    can = os.geteuid() == 0 and shutil.which("mount")
    if not can or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no disk of its own")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def until_logged(daemon: Touched, subscriber: Heard, line: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while line not in daemon.log:
        assert time.monotonic() < deadline, daemon.log
        subscriber.listen(0.2)


def test_while_the_disk_is_full_the_recording_alone_waits(tmp_path: Path, small_disk: Path) -> None:
    filling = small_disk / "filling"
    with (
        touched(tmp_path, session=small_disk / "session") as daemon,
        heard(daemon) as subscriber,
    ):
        daemon.until_touched()
        subprocess.run(["dd", "if=/dev/zero", f"of={filling}"], capture_output=True, check=False)
        until_logged(daemon, subscriber, "the recording waits")
        before = len(subscriber.estimates)
        subscriber.listen(1.0)
        assert len(subscriber.estimates) > before
        filling.unlink()
        until_logged(daemon, subscriber, "the recording goes on")
        sent = daemon.stop()
        replayed = daemon.replay()
    assert len(replayed) == sent
    assert check_replayed(subscriber, replayed) > 10


def test_a_file_that_may_grow_no_more_ends_the_recording_alone(tmp_path: Path) -> None:
    with (
        touched(tmp_path, before="ulimit -f 64") as daemon,  # blocks of 512 or 1024 bytes
        heard(daemon) as subscriber,
    ):
        daemon.until_touched()
        until_logged(daemon, subscriber, "the recording has ended")
        subscriber.listen(1.0)
        status, replayed = daemon.status(), daemon.replay()
        sent = daemon.stop()
    assert status is not None
    assert status["health"]["recording"]["failed"]
    assert status["estimate"]["t"] > replayed[-1]["t"] + 0.5
    assert 20 < len(replayed) < sent
    assert check_replayed(subscriber, replayed[:-1]) > 0


def test_a_daemon_whose_standard_files_are_closed_serves(tmp_path: Path) -> None:
    """The pair, the device and a recording get their numbers then."""
    with touched(tmp_path, before="exec 0<&- 1>&- 2>&-") as daemon:
        daemon.until_touched()
        daemon.stop(whole=False)
        assert len(daemon.replay()) > 20
