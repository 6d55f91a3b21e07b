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

    def __init__(self, place: Path, session: Path, skin: Skin) -> None:
        self.skin, self.session = skin, session
        self._control = f"ipc://{place}/control"
        config = configuration(place, source=skin.source, filter={"proposal": "manifold"})
        shell = ["sh", "-c", 'exec "$@" 0<&- 1>&- 2>&-', "sh", *TAXELD, "run", str(config)]
        self.process = subprocess.Popen([*shell, "--record", str(session)])
        self._context: zmq.Context[Any] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.subscribe(b"/taxeld/estimate")
        self._socket.connect(f"ipc://{place}/stream")
        self.estimates: list[dict[str, Any]] = []

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

    def stop(self) -> int:
        """Have the skin fall silent, then end the daemon; → the scans that the skin has sent."""
        self.skin.does = "quiet"
        time.sleep(0.1)
        until(lambda: self.health()["source"]["scans"] >= self.skin.sent)
        self.process.terminate()
        assert self.process.wait(PATIENCE_S) == 0
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


def test_a_killed_door_a_lost_device_and_a_full_disk_cost_a_daemon_no_scan_and_no_record(
    tmp_path: Path, small_disk: Path
) -> None:
    """One life of it. Its standard files are closed: the pair, the device and the recording get
    their numbers."""
    filling = small_disk / "filling"
    with (
        Skin(tmp_path, touches=400) as skin,
        contextlib.closing(Recorded(tmp_path, small_disk / "session", skin)) as daemon,
    ):
        daemon.until_touched()
        os.kill(door_of(daemon.process.pid), signal.SIGKILL)
        until(lambda: daemon.health()["door"]["starts"] > 1)
        daemon.listen(1.0)
        door = door_of(daemon.process.pid)
        subprocess.run(["dd", "if=/dev/zero", f"of={filling}"], capture_output=True, check=False)
        before = len(daemon.estimates)
        daemon.listen(2.0)
        assert len(daemon.estimates) > before, "the recording alone waits"
        filling.unlink()
        daemon.listen(1.0)
        skin.does = "away"
        until(lambda: daemon.health()["source"]["lost"] == 1)
        skin.does = "serve"
        daemon.listen(1.0)
        assert door_of(daemon.process.pid) == door
        sent, again = daemon.stop(), daemon.replay()
    assert len(again) == sent > 80
    assert daemon.check_replayed(again) > 10
