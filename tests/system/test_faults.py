"""Faults of honest life on a daemon as a process: no scan is lost, and its recording tells all."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.stream import client
from tests.rig.clocks import PATIENCE_S, until
from tests.rig.configurations import configuration
from tests.rig.processes import TAXELD, door_of, replayed
from tests.rig.recorded import LiveSkin

pytestmark = pytest.mark.check

NEAR = 1e-6  # a recording keeps the microseconds of a scan's time, and no less


class Skin(LiveSkin):
    """A skin that is touched all the time, and does as it is told: `serve`, `away` or `quiet`."""

    does = "serve"

    def run(self) -> None:
        did = self.does
        with self._hub as hub:
            while not self._stops.wait(0.002):
                if self.does != did:
                    if self.does == "away":
                        hub.unplug()
                    elif did == "away":
                        hub.plug()
                    did = self.does
                if did == "serve":
                    hub.serve(time.monotonic(), lambda k: self._scans[k])
                elif did == "quiet":
                    hub.answer(time.monotonic())

    @property
    def sent(self) -> int:
        """How many scans it has sent."""
        return self._hub.scans


class Recorded:
    """`taxeld run` with a recording, its skin, and a subscriber."""

    def __init__(self, place: Path, session: Path | None, before: str, skin: Skin) -> None:
        """`before`: what the shell does first."""
        self.skin, self.session = skin, session or place / "session"
        self._log, self._control = place / "log", f"ipc://{place}/control"
        few = {"proposal": "manifold"}
        config = configuration(place, source=skin.source, filter=few)
        shell = ["sh", "-c", f'{before}\nexec "$@"', "sh", *TAXELD, "run", str(config)]
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                [*shell, "--record", str(self.session)], stdout=log, stderr=log
            )
        self._context: zmq.Context[Any] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.subscribe(b"/taxeld/estimate")
        self._socket.connect(f"ipc://{place}/stream")
        self.estimates: list[dict[str, Any]] = []

    @property
    def log(self) -> str:
        return self._log.read_text(encoding="utf-8")

    def status(self) -> dict[str, Any] | None:
        answer = client.ask(self._control, "status")
        return answer if answer and answer.get("health") else None

    def health(self) -> dict[str, Any]:
        return until(self.status)["health"]  # type: ignore[no-any-return]

    def until_touched(self) -> None:
        until(lambda: (self.status() or {"estimate": {}})["estimate"].get("contacts"))

    def listen(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0.0:
            if self._socket.poll(1000.0 * left_s):
                self.estimates.append(msgpack.unpackb(self._socket.recv_multipart()[1]))

    def until_logged(self, line: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while line not in self.log:
            assert time.monotonic() < deadline, self.log
            self.listen(0.2)

    def stop(self, *, whole: bool = True) -> int:
        """Have the skin fall silent, and then end the daemon; → the scans that the skin has sent.
        `whole`: all of them are waited for."""
        self.skin.does = "quiet"
        time.sleep(0.1)
        if whole:
            until(lambda: self.health()["source"]["scans"] >= self.skin.sent)
        self.process.terminate()
        assert self.process.wait(PATIENCE_S) == 0, self.log
        return self.skin.sent

    def replay(self) -> list[dict[str, Any]]:
        """An estimate for each scan of the recording."""
        return [json.loads(line) for line in replayed(self.session).splitlines()]

    def check_replayed(self, again: list[dict[str, Any]]) -> int:
        """What was heard last of a scan is what the recording replays to; → of how many scans."""
        by_time = {round(1e6 * estimate["t"]): estimate for estimate in again}
        pairs = zip(self.estimates, self.estimates[1:], strict=False)
        last = [a for a, b in pairs if b["seq"] == a["seq"] + 1 and b["t"] != a["t"]]
        last = [told for told in last if round(1e6 * told["t"]) in by_time]
        for told in last:
            found = by_time[round(1e6 * told["t"])]
            assert told["contacts"] == found["contacts"]
            for pose in ("map", "mean"):
                assert told[pose] == pytest.approx(found[pose], abs=NEAR)
            assert told["ess"] == pytest.approx(found["ess"], rel=NEAR)
        return len(last)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._context.destroy(linger=0)


@contextlib.contextmanager
def recorded(place: Path, session: Path | None = None, before: str = "") -> Iterator[Recorded]:
    with (
        Skin(place, touches=400) as skin,
        contextlib.closing(Recorded(place, session, before, skin)) as made,
    ):
        yield made


def test_a_door_that_is_killed_each_second_costs_no_scan_and_no_record(tmp_path: Path) -> None:
    with recorded(tmp_path) as daemon:
        daemon.until_touched()
        for _ in range(4):
            with contextlib.suppress(ProcessLookupError):
                os.kill(door_of(daemon.process.pid) or daemon.process.pid + 1, signal.SIGKILL)
            daemon.listen(1.0)
        assert daemon.health()["door"]["starts"] > 2
        sent, again = daemon.stop(), daemon.replay()
    assert len(again) == sent > 80
    assert daemon.check_replayed(again) > 10
    assert "cut" not in daemon.log


def test_a_device_that_goes_each_second_is_opened_again(tmp_path: Path) -> None:
    with recorded(tmp_path) as daemon:
        daemon.until_touched()
        door = door_of(daemon.process.pid)
        for losses in (1, 2):
            daemon.skin.does = "away"
            until(lambda n=losses: daemon.health()["source"]["lost"] == n)
            daemon.skin.does = "serve"
            daemon.listen(1.0)
        assert door_of(daemon.process.pid) == door
        daemon.stop(whole=False)
        assert daemon.check_replayed(daemon.replay()) > 10


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


def test_while_the_disk_is_full_the_recording_alone_waits(tmp_path: Path, small_disk: Path) -> None:
    filling = small_disk / "filling"
    with recorded(tmp_path, small_disk / "session") as daemon:
        daemon.until_touched()
        subprocess.run(["dd", "if=/dev/zero", f"of={filling}"], capture_output=True, check=False)
        daemon.until_logged("the recording waits")
        before = len(daemon.estimates)
        daemon.listen(1.0)
        assert len(daemon.estimates) > before
        filling.unlink()
        daemon.until_logged("the recording goes on")
        sent, again = daemon.stop(), daemon.replay()
    assert len(again) == sent
    assert daemon.check_replayed(again) > 10


def test_a_file_that_may_grow_no_more_ends_the_recording_alone(tmp_path: Path) -> None:
    with recorded(tmp_path, before="ulimit -f 64") as daemon:  # blocks of 512 or 1024 bytes
        daemon.until_touched()
        daemon.until_logged("the recording has ended")
        daemon.listen(1.0)
        status, again = until(daemon.status), daemon.replay()
        sent = daemon.stop()
    assert status["health"]["recording"]["failed"]
    assert status["estimate"]["t"] > again[-1]["t"] + 0.5
    assert 20 < len(again) < sent
    assert daemon.check_replayed(again[:-1]) > 0


def test_a_daemon_whose_standard_files_are_closed_serves(tmp_path: Path) -> None:
    """The pair, the device and a recording get their numbers then."""
    with recorded(tmp_path, before="exec 0<&- 1>&- 2>&-") as daemon:
        daemon.until_touched()
        daemon.stop(whole=False)
        assert len(daemon.replay()) > 20
