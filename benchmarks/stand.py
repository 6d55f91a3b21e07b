"""A daemon as a process of its own, a virtual skin and a robot before it, subscribers behind it.

The skin sends twenty scans a second through an SLCAN adapter on a pseudo-terminal, the robot a
hundred poses. Touched means: pressed by a box between 1.5 and 4.5 mm deep that rolls along the skin
all the time, so that every few scans tell something new. CPU time is the kernel's account of the
daemon and of the processes that it starts.
"""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq

from taxeld.layout import read as layouts
from taxeld.model import contacts, se2
from taxeld.proposals import bundle
from taxeld_hil.rig.ledger import WireUnit
from taxeld_hil.rig.ports import SlcanPort
from taxeld_protocol import cyskin
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import Answer, VirtualIhb

SKIN = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
FULL_SCALE, IDLE_COUNTS, NOISE = 20_000.0, 10_000.0, 34.0
POSE_S = 0.01
SETTLE_S = 4.0  # the baseline, and the first touches
READY_S = 30.0
ROLL_HZ, PRESS_HZ = 0.13, 0.31
DEPTH_M = (0.0015, 0.0045)
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
        now = time.monotonic()
        if topic == b"/taxeld/estimate":
            estimate = msgpack.unpackb(body)
            heard.append((one.fileno(), now, estimate["t"], estimate["injected"] > 0))
print(json.dumps(heard))
"""


@dataclass(frozen=True)
class Load:
    touched: bool
    layout: str = SKIN
    bundle: str = "box"
    record: bool = False
    alone: bool = False  # without an object: `bundle` is what is felt
    subscribers: int = 1


@dataclass(frozen=True)
class Measured:
    cpu_percent: float
    updates_hz: float
    reached_ms: np.ndarray  # [K] from a scan's last frame to a subscriber of its estimate
    sampled_ms: np.ndarray  # [L] the same, of estimates that brought samples
    last_ms: np.ndarray  # [M] the same, to the last of the subscribers
    lat_us: dict[str, float]  # a scan's way through the loop: p50, p99, max
    start_cpu_s: float
    resident_mb: float
    grown_mb: float
    own_overruns: int
    overruns: int


def measure(case: Load, seconds: float, place: Path) -> Measured:
    """Run the daemon on the case; what it took between settling and the end."""
    loaded = bundle.load(case.bundle, layouts.load(case.layout), 0.005)
    with (
        tempfile.TemporaryDirectory(dir=place) as name,
        closing(RollingBox(loaded, case.touched, Path(name))) as robot,
        _daemon(case, Path(name)) as (pid, ready),
    ):
        robot.serve_until(ready)
        start_cpu_s = cpu_s(pid)
        with _subscribers(Path(name), case.subscribers) as hear:
            robot.serve(SETTLE_S)
            before = _health(Path(name), robot)
            spent_s, resident = cpu_s(pid), resident_mb(pid)
            robot.sent_s.clear()
            robot.serve(seconds)
            spent_s, grown_mb = cpu_s(pid) - spent_s, resident_mb(pid) - resident
            after = _health(Path(name), robot)
            delays = delays_ms(np.array(robot.sent_s), hear())
    updates = after["estimator"]["updates"] - before["estimator"]["updates"]
    return Measured(
        cpu_percent=100.0 * spent_s / seconds,
        updates_hz=updates / (after["uptime_s"] - before["uptime_s"]),
        reached_ms=delays[:, :, 0].ravel(),
        sampled_ms=delays[:, :, 0][delays[:, :, 1] > 0],
        last_ms=delays[:, :, 0].max(axis=0, initial=0.0),
        lat_us=after["lat_us"]["total"],
        start_cpu_s=start_cpu_s,
        resident_mb=resident + grown_mb,
        grown_mb=grown_mb,
        own_overruns=after["loop"]["own_overruns"],
        overruns=after["loop"]["overruns"],
    )


def delays_ms(sent_s: np.ndarray, heard: list[tuple[int, float, float, bool]]) -> np.ndarray:
    """For each subscriber and scan [S, K] the delay of its first estimate, and whether that brought
    samples; scans that one of the subscribers has no estimate of are left out."""
    found: dict[int, dict[int, tuple[float, bool]]] = {}
    newest: dict[int, float] = {}
    for one, at_s, t, sampled in heard:
        scans = found.setdefault(one, {})
        scan = int(np.searchsorted(sent_s, at_s)) - 1
        if scan >= 0 and t > newest.get(one, 0.0) and scan not in scans:
            scans[scan] = (1e3 * (at_s - sent_s[scan]), sampled)
        newest[one] = t
    common = sorted(set.intersection(*map(set, found.values()))) if found else []
    listed = [[scans[scan] for scan in common] for scans in found.values()]
    return np.array(listed, dtype=float).reshape(len(found), len(common), 2)


class RollingBox:
    """A box that rolls along the skin, or stays away from it, and the hub that feels it."""

    def __init__(self, loaded: bundle.Bundle, touched: bool, place: Path) -> None:
        self.sent_s: list[float] = []  # monotonic, of each scan's last frame
        self._model, self._touched = loaded.model, touched
        self._hub = VirtualIhb(wired(self._model.layout.uid.tolist()))
        self._port = SlcanPort(place / "skin", lambda _: None)
        self._context = zmq.Context()
        self._poses = self._context.socket(zmq.PUB)
        self._poses.bind(f"ipc://{place}/poses")
        self._rng = np.random.default_rng(0)
        made = contacts.synthesise(
            self._model.scene, self._model.layout.radius_m, 0.005, 500, self._rng
        ).pose
        self._seen = made[np.argmax(self._model.activation(made).max(axis=1))]
        self._towards = self._seen[:2] / np.linalg.norm(self._seen[:2])
        index = {int(uid): i for i, uid in enumerate(self._model.layout.uid)}
        uids = [uid for module in self._hub.modules for uid in module.uids]
        self._taxel = np.array([index.get(uid, -1) for uid in uids])
        self._next_pose_s = self._began = time.monotonic()

    def serve(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._step()

    def serve_until(self, ready: socket.socket) -> None:
        deadline = time.monotonic() + READY_S
        while not select.select([ready], [], [], 0)[0]:
            assert time.monotonic() < deadline, "the daemon was never ready"
            self._step()

    def close(self) -> None:
        self._port.close()
        self._context.destroy(linger=0)

    def _step(self) -> None:
        select.select([self._port], [], [], 0.002)
        now, wall = time.monotonic(), time.time()
        for packet in self._port.take(wall):
            self._send(self._hub.answer(packet))
        yaw, deeper_m = self._at(now - self._began)
        x, y = self._towards * deeper_m
        if now >= self._next_pose_s:
            self._next_pose_s = max(self._next_pose_s + POSE_S, now)
            body = msgpack.packb({"t": wall, "x": float(x), "y": float(y), "theta": yaw})
            self._poses.send_multipart((b"/robot/sensor_pose", body, b"%.6f" % wall), zmq.NOBLOCK)
        if self._hub.due(now):
            self._send(self._hub.sensor_data(self._counts(np.array([x, y, yaw]))))
            self.sent_s.append(time.monotonic())
        self._port.flush()

    def _send(self, answers: Iterable[Answer]) -> None:
        for command, payload in answers:
            for frame in cyskin.to_frames(command, payload, ihb=self._hub.short_id, t=0.0):
                if self._port.is_open:
                    self._port.send(WireUnit(frame, None))

    def _at(self, t: float) -> tuple[float, float]:
        """Yaw of the sensor and how much nearer to the object it is than at the start."""
        yaw = float(np.sin(2.0 * np.pi * ROLL_HZ * t))
        low, high = DEPTH_M
        depth = low + (high - low) * 0.5 * (1.0 + np.sin(2.0 * np.pi * PRESS_HZ * t))
        return yaw, depth - high

    def _counts(self, sensor: np.ndarray) -> list[int]:
        seen = se2.compose(se2.inverse(sensor), self._seen)
        z = self._model.activation(seen[None])[0] * self._touched
        z = np.append(z, 0.0)[self._taxel]  # a temperature channel feels nothing
        counts = IDLE_COUNTS + FULL_SCALE * z + NOISE * self._rng.standard_normal(len(z))
        return [int(c) for c in np.clip(np.round(counts), 1, 65534)]


@contextmanager
def _daemon(case: Load, place: Path) -> Iterator[tuple[int, socket.socket]]:
    """`taxeld run`: its process and the socket on which it says that it is ready."""
    settings = place / "config.toml"
    known = f'[scene]\nbundle = "{case.bundle}"\n[filter]\nparticles_max = 100\n'
    settings.write_text(
        f'[skin]\nlayout = "{case.layout}"\nfull_scale_counts = {FULL_SCALE}\n'
        f'[source]\nkind = "can"\ninterface = "slcan"\nchannel = "{place}/skin"\n'
        f'{"" if case.alone else known}[sensor_pose]\nendpoint = "ipc://{place}/poses"\n'
        f'[publish]\nendpoints = ["ipc://{place}/stream"]\n'
        f'[control]\nendpoint = "ipc://{place}/control"\n',
        encoding="utf-8",
    )
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
        ready.bind(str(place / "notify"))
        environ = {
            **os.environ,
            "NOTIFY_SOCKET": str(place / "notify"),
            "PYTHONDONTWRITEBYTECODE": "",  # later starts find compiled files
            "PYTHONPYCACHEPREFIX": str(place.parent / "compiled"),
        }
        recorded = ["--record", str(place / "session")] if case.record else []
        command = [sys.executable, "-m", "taxeld.cli", "run", *recorded, str(settings)]
        process = subprocess.Popen(command, env=environ)
        try:
            yield process.pid, ready
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait()


@contextmanager
def _subscribers(place: Path, count: int) -> Iterator[Any]:
    """Subscribers in one process; yields what ends them and returns all that they heard."""
    command = [sys.executable, "-c", SUBSCRIBERS, f"ipc://{place}/stream", str(count)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True) as process:  # type: ignore[call-overload]
        yield lambda: json.loads(process.communicate()[0])


def _health(place: Path, robot: RollingBox) -> dict[str, Any]:
    """The daemon's health, not older than a second."""
    robot.serve(1.1)
    with zmq.Context() as context, context.socket(zmq.REQ) as asking:
        asking.linger = 0
        asking.connect(f"ipc://{place}/control")
        asking.send(msgpack.packb({"cmd": "status"}))
        assert asking.poll(5000), "the daemon does not answer"
        health = msgpack.unpackb(asking.recv())["health"]
    assert isinstance(health, dict)
    return health


def processes(pid: int) -> list[int]:
    """A process and all that it has started."""
    found = [pid]
    for one in found:
        for path in Path(f"/proc/{one}/task").glob("*/children"):
            found += map(int, path.read_text(encoding="ascii").split())
    return found


def cpu_s(pid: int) -> float:
    """CPU time of a process and of those that it has started."""
    ticks = 0
    for one in processes(pid):
        fields = Path(f"/proc/{one}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def resident_mb(pid: int) -> float:
    """Resident memory of a process and of those that it has started."""
    pages = sum(
        int(Path(f"/proc/{one}/statm").read_text(encoding="ascii").split()[1])
        for one in processes(pid)
    )
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
