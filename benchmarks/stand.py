"""Daemons as processes of their own, each behind a virtual skin, with a robot and subscribers.

Several of one case run side by side, so that what else the machine does meets them alike: this
checkout's, and another's to compare it with. Each has the harness's rig, twenty scans a second
through an SLCAN adapter on a pseudo-terminal and a hundred poses. CPU time is the kernel's account
of a daemon and of the processes that it starts.
"""

import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.stream import client
from taxeld_hil.rig.bench import Bench
from taxeld_hil.rig.rig import Rig
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import Scenario

SKIN = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
AWAY_M = np.array([5.0, 5.0, 0.0])  # where an untouched skin's object stands instead
SETTLE_S, WINDOW_S, STEP_S, READY_S = 4.0, 4.0, 0.002, 60.0
SCAN_S = 0.05
OLDER = {  # lines of the configuration, as a checkout has them that knows `source.framing`
    'kind = "can"\ninterface = "slcan"': 'kind = "serial"\nframing = "slcan"',
    "sigma_m = 0.001\n": "",
}
# of all topics; when standard input ends, it prints each estimate's monotonic time and its own
SUBSCRIBER = """
import json, sys, time, msgpack, zmq
poller, heard, stream = zmq.Poller(), [], zmq.Context().socket(zmq.SUB)
stream.subscribe(b"")
stream.connect(sys.argv[1])
poller.register(stream, zmq.POLLIN)
poller.register(0, zmq.POLLIN)
while 0 not in dict(poller.poll()):
    topic, body, *_ = stream.recv_multipart()
    if topic == b"/taxeld/estimate":
        heard.append((time.monotonic(), msgpack.unpackb(body)["t"]))
print(json.dumps(heard))
"""


@dataclass(frozen=True)
class Load:
    touched: bool  # the robot presses all the time, on all sides of a box; or it stands still
    layout: str = SKIN
    bundle: str = "box"


@dataclass
class Measured:
    """One daemon's figures."""

    start_cpu_s: float = 0.0  # until it is ready
    cpu_percent: list[float] = field(default_factory=list)  # a core's share, window by window
    resident_mb: list[float] = field(default_factory=list)  # with each window
    reached_ms: Any = None  # (K,) from a scan's last frame to a subscriber of its estimate
    health: dict[str, Any] = field(default_factory=dict)


class Stand:
    """One daemon, its rig and its subscribers."""

    def __init__(self, case: Load, checkout: Path, opened: ExitStack) -> None:
        self.found, self._sent_s, self._spent_s = Measured(), list[float](), 0.0
        self._opened = opened
        self._place = place = Path(opened.enter_context(tempfile.TemporaryDirectory()))
        contacts = 1000 if case.touched else 1  # the one is missed before the measurement begins
        touches = Scenario(case.bundle, layout=case.layout, contacts=contacts, physics="scene")
        rig = Rig(touches, 0)
        rig.world.truth = rig.world.truth + (0.0 if case.touched else AWAY_M)
        self.bench = Bench(rig, place / "skin", f"ipc://{place}/poses")
        opened.callback(self.bench.close)
        self._ready = opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        self._ready.bind(f"{place}/notify")
        where = f"{place}/skin", f"ipc://{place}/poses", place
        text = settings.text(touches, 0, *where) + 'particles_max = 100\n[log]\nlevel = "error"\n'
        tables = (checkout / "daemon/taxeld/config/tables.py").read_text(encoding="utf-8")
        for now, then in OLDER.items() if "framing:" in tables else ():
            text = text.replace(now, then)
        (place / "config.toml").write_text(text, encoding="utf-8")
        environ = {
            **os.environ,
            "NOTIFY_SOCKET": f"{place}/notify",
            "PYTHONPATH": f"{checkout}/firmware_protocol:{checkout}/daemon",
            "PYTHONDONTWRITEBYTECODE": "",  # later starts find compiled files
            "PYTHONPYCACHEPREFIX": f"{tempfile.gettempdir()}/compiled{checkout}",
        }
        command = [sys.executable, "-m", "taxeld.cli", "run", f"{place}/config.toml"]
        self._daemon = subprocess.Popen(command, env=environ, cwd=checkout)
        opened.callback(self._daemon.wait)
        opened.callback(self._daemon.send_signal, signal.SIGTERM)

    def step(self) -> None:
        sent = self.bench.rig.ledger.fates.scans
        self.bench.step()
        self._sent_s += [time.monotonic()] * (self.bench.rig.ledger.fates.scans - sent)

    def is_ready(self) -> bool:
        """Whether the daemon says so for the first time; then its subscribers come."""
        assert self._daemon.poll() is None, "the daemon has ended"
        if self.found.start_cpu_s or not select.select([self._ready], [], [], 0)[0]:
            return False
        self.found.start_cpu_s = cpu_s(self._daemon.pid)
        command, pipe = [sys.executable, "-c", SUBSCRIBER], subprocess.PIPE
        command.append(f"ipc://{self._place}/stream")
        self._heard = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        self._opened.callback(self._heard.communicate)
        return True

    def begin(self) -> None:
        """The first window begins."""
        self._sent_s, self._spent_s = [], cpu_s(self._daemon.pid)

    def look(self, window_s: float) -> None:
        """A window is over."""
        before, self._spent_s = self._spent_s, cpu_s(self._daemon.pid)
        self.found.cpu_percent.append(100.0 * (self._spent_s - before) / window_s)
        self.found.resident_mb.append(resident_mb(self._daemon.pid))

    def end(self) -> Measured:
        """All windows are over."""
        answer = client.ask(f"ipc://{self._place}/control", "status", 5.0)
        assert answer is not None, "the daemon does not answer"
        self.found.health = answer["health"]
        heard = json.loads(self._heard.communicate()[0])
        self.found.reached_ms = delays_ms(np.array(self._sent_s), heard)
        return self.found


def measure(case: Load, seconds: float, checkouts: Sequence[Path]) -> list[Measured]:
    """Run the daemons of these checkouts on the case, side by side."""
    with ExitStack() as opened:
        stands = [Stand(case, each, opened) for each in checkouts]
        for _ in stands:
            _serve(stands, READY_S, lambda: any(stand.is_ready() for stand in stands))
        _serve(stands, SETTLE_S)
        for turn, stand in enumerate(stands):  # else they would get in each other's way
            stand.bench.rig.hub._next_s = time.monotonic() + SCAN_S * (1.0 + turn / len(stands))
        _serve(stands, SETTLE_S)
        for stand in stands:
            stand.begin()
        for _ in range(max(round(seconds / WINDOW_S), 1)):
            took_s = _serve(stands, WINDOW_S)
            for stand in stands:
                stand.look(took_s)
        return [stand.end() for stand in stands]


def _serve(
    stands: Sequence[Stand], seconds: float, holds: Callable[[], bool] = lambda: False
) -> float:
    """Step all of them for so long, or until it `holds`; → how long that was."""
    began_s = time.monotonic()
    while time.monotonic() < began_s + seconds and not holds():
        time.sleep(STEP_S)
        for stand in stands:
            stand.step()
    return time.monotonic() - began_s


def delays_ms(sent_s: Any, heard: list[tuple[float, float]]) -> Any:
    """(K,) the delay of each scan's estimate."""
    found: dict[int, float] = {}
    newest = 0.0
    for at_s, t in heard:
        scan = int(np.searchsorted(sent_s, at_s)) - 1
        if scan >= 0 and t > newest:
            found.setdefault(scan, 1e3 * (at_s - sent_s[scan]))
        newest = t
    return np.array(list(found.values()))


def processes(pid: int) -> list[Path]:
    """A process and all that it has started."""
    found = [Path(f"/proc/{pid}")]
    for one in found:
        for path in one.glob("task/*/children"):
            found += [Path("/proc", child) for child in path.read_text().split()]
    return found


def cpu_s(pid: int) -> float:
    """CPU time of a process and of those that it has started."""
    accounts = [path for one in processes(pid) for path in one.glob("task/*/schedstat")]
    return sum(int(path.read_text().split()[0]) for path in accounts) / 1e9


def resident_mb(pid: int) -> float:
    """Resident memory of a process and of those that it has started."""
    texts = [(one / "status").read_text() for one in processes(pid)]
    return sum(int(re.findall(r"VmRSS:\s+(\d+)", text)[0]) for text in texts) / 1024.0
