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
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq

from taxeld_hil.rig.bench import Bench
from taxeld_hil.rig.rig import Rig
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import Scenario

ROOTS = "firmware_protocol", "daemon"  # of a checkout, for its daemon
SKIN = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
AWAY_M = np.array([5.0, 5.0, 0.0])  # where an untouched skin's object stands instead
SETTLE_S, WINDOW_S, STEP_S, READY_S = 5.0, 4.0, 0.002, 60.0
OLDER = {  # keys of the configuration before → as a checkout with `source.framing` has them
    'kind = "can"\ninterface = "slcan"': 'kind = "serial"\nframing = "slcan"',
    "sigma_m = 0.001\n": "",
}
# `count` subscribers of all topics; when standard input ends, each estimate with its monotonic time
SUBSCRIBERS = """
import json, sys, time, msgpack, zmq
context, poller, heard = zmq.Context(), zmq.Poller(), []
poller.register(0, zmq.POLLIN)
for _ in range(int(sys.argv[2])):
    one = context.socket(zmq.SUB)
    one.subscribe(b"")
    one.connect(sys.argv[1])
    poller.register(one, zmq.POLLIN)
while 0 not in (ready := dict(poller.poll())):
    for one in ready:
        topic, body, *_ = one.recv_multipart()
        if topic == b"/taxeld/estimate":
            heard.append((one.fileno(), time.monotonic(), msgpack.unpackb(body)["t"]))
print(json.dumps(heard))
"""


@dataclass(frozen=True)
class Case:
    touched: bool  # the robot presses all the time, on all sides of a box
    layout: str = SKIN
    bundle: str = "box"
    subscribers: int = 1


@dataclass
class Measured:
    """One daemon's figures."""

    start_cpu_s: float = 0.0  # CPU time until it is ready
    cpu_percent: list[float] = field(default_factory=list)  # a core's share, window by window
    resident_mb: list[float] = field(default_factory=list)  # at the begin and at the end
    reached_ms: Any = None  # [K] from a scan's last frame to the last subscriber of its estimate
    health: dict[str, Any] = field(default_factory=dict)


class Stand:
    """One daemon, its rig and its subscribers."""

    def __init__(self, case: Case, checkout: Path, place: Path, opened: ExitStack) -> None:
        self.found, self._place, self._sent_s = Measured(), place, list[float]()
        touches = Scenario(case.bundle, layout=case.layout, contacts=1000, physics="scene")
        rig = Rig(touches, 0)
        if not case.touched:
            rig.world.truth = rig.world.truth + AWAY_M
        context = opened.enter_context(zmq.Context())
        poses = opened.enter_context(context.socket(zmq.XPUB))
        poses.linger = 0
        poses.bind(f"ipc://{place}/poses")
        self._bench = Bench(rig, place / "skin", poses)
        opened.callback(self._bench.close)
        self._ready = opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        self._ready.bind(str(place / "notify"))
        text = '[log]\nlevel = "error"\n' + settings.text(
            touches, 0, f"{place}/skin", f"ipc://{place}/poses", place, "particles_max = 100"
        )
        if "framing:" in (checkout / "daemon/taxeld/config/tables.py").read_text(encoding="utf-8"):
            for now, then in OLDER.items():
                text = text.replace(now, then)
        (place / "config.toml").write_text(text, encoding="utf-8")
        environ = {
            **os.environ,
            "NOTIFY_SOCKET": str(place / "notify"),
            "PYTHONPATH": os.pathsep.join(str(checkout / root) for root in ROOTS),
            "PYTHONDONTWRITEBYTECODE": "",  # later starts find compiled files
            "PYTHONPYCACHEPREFIX": str(Path(tempfile.gettempdir()) / f"bench{hash(checkout):x}"),
        }
        command = [sys.executable, "-m", "taxeld.cli", "run", str(place / "config.toml")]
        self._daemon = subprocess.Popen(command, env=environ, cwd=checkout)
        opened.callback(self._daemon.wait)
        opened.callback(self._daemon.send_signal, signal.SIGTERM)
        self._count, self._opened = case.subscribers, opened
        self._spent_s = 0.0

    def step(self) -> None:
        before = self._bench.rig.ledger.scans_sent
        self._bench.step()
        if self._bench.rig.ledger.scans_sent > before:
            self._sent_s.append(time.monotonic())

    @property
    def is_ready(self) -> bool:
        """Whether the daemon has said so since the last call."""
        assert self._daemon.poll() is None, "the daemon has ended"
        return bool(select.select([self._ready], [], [], 0)[0])

    def started(self) -> None:
        """The daemon is ready: subscribers come."""
        self.found.start_cpu_s = cpu_s(self._daemon.pid)
        command = [sys.executable, "-c", SUBSCRIBERS, f"ipc://{self._place}/stream"]
        pipe = subprocess.PIPE
        self._heard = self._opened.enter_context(
            subprocess.Popen([*command, str(self._count)], stdin=pipe, stdout=pipe, text=True)
        )
        self._opened.callback(self._heard.kill)

    def begin(self) -> None:
        """The first window begins."""
        self._sent_s.clear()
        self._spent_s = cpu_s(self._daemon.pid)
        self.found.resident_mb.append(resident_mb(self._daemon.pid))

    def look(self, window_s: float) -> None:
        """A window is over."""
        before, self._spent_s = self._spent_s, cpu_s(self._daemon.pid)
        self.found.cpu_percent.append(100.0 * (self._spent_s - before) / window_s)

    def end(self) -> Measured:
        """All windows are over."""
        self.found.resident_mb.append(resident_mb(self._daemon.pid))
        with zmq.Context() as context, context.socket(zmq.REQ) as asking:
            asking.linger = 0
            asking.connect(f"ipc://{self._place}/control")
            asking.send(msgpack.packb({"cmd": "status"}))
            assert asking.poll(5000), "the daemon does not answer"
            self.found.health = msgpack.unpackb(asking.recv())["health"]
        heard = json.loads(self._heard.communicate()[0])
        self.found.reached_ms = delays_ms(np.array(self._sent_s), heard, self._count)
        return self.found


def measure(case: Case, seconds: float, checkouts: Sequence[Path]) -> list[Measured]:
    """Run the daemons of these checkouts on the case, side by side."""
    with ExitStack() as opened:
        places = [Path(opened.enter_context(tempfile.TemporaryDirectory())) for _ in checkouts]
        stands = [
            Stand(case, each, place, opened) for each, place in zip(checkouts, places, strict=True)
        ]
        waited, until_s = list(stands), time.monotonic() + READY_S
        while waited:
            assert time.monotonic() < until_s, "a daemon was never ready"
            _serve(stands, STEP_S)
            for stand in [one for one in waited if one.is_ready]:
                stand.started()
                waited.remove(stand)
        _serve(stands, SETTLE_S)
        for stand in stands:
            stand.begin()
        for _ in range(max(round(seconds / WINDOW_S), 1)):
            began_s = time.monotonic()
            _serve(stands, WINDOW_S)
            for stand in stands:
                stand.look(time.monotonic() - began_s)
        return [stand.end() for stand in stands]


def _serve(stands: Sequence[Stand], seconds: float) -> None:
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        time.sleep(STEP_S)
        for stand in stands:
            stand.step()


def delays_ms(sent_s: Any, heard: list[tuple[int, float, float]], count: int) -> Any:
    """(K,) for each scan the delay of its estimate to the last of `count` subscribers."""
    found: dict[int, list[float]] = {}
    newest: dict[int, float] = {}
    for one, at_s, t in heard:
        scan = int(np.searchsorted(sent_s, at_s)) - 1
        if scan >= 0 and t > newest.get(one, 0.0):
            found.setdefault(scan, []).append(1e3 * (at_s - sent_s[scan]))
        newest[one] = t
    return np.array([max(each) for each in found.values() if len(each) == count])


def processes(pid: int) -> list[int]:
    """A process and all that it has started."""
    found = [pid]
    for one in found:
        for path in Path(f"/proc/{one}/task").glob("*/children"):
            found += map(int, path.read_text(encoding="ascii").split())
    return found


def cpu_s(pid: int) -> float:
    """CPU time of a process and of those that it has started."""
    threads = [path for one in processes(pid) for path in Path(f"/proc/{one}/task").iterdir()]
    return sum(int((path / "schedstat").read_text().split()[0]) for path in threads) / 1e9


def resident_mb(pid: int) -> float:
    """Resident memory of a process and of those that it has started."""
    texts = [Path(f"/proc/{one}/status").read_text(encoding="ascii") for one in processes(pid)]
    return sum(int(re.findall(r"VmRSS:\s+(\d+)", text)[0]) for text in texts) / 1024.0
