"""The daemon as a process of its own behind a pseudo-terminal: CPU time, memory, start, overruns.

    python benchmarks/service.py [--seconds 20] [--long MINUTES] [--ticks 1000000] [--json FILE]

A virtual skin behind an SLCAN adapter sends twenty scans a second, a robot a hundred poses, and a
subscriber hears everything; N = 100, S = 50. Touched all the time means: pressed by a box between
1.5 and 4.5 mm deep that rolls along it, so that every few scans tell something new. CPU time is
that of the whole process, by the kernel's account.
"""

import argparse
import json
import os
import re
import select
import shutil
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

import msgpack
import numpy as np
import zmq

import memory
import streams
from taxeld.layout import read as layouts
from taxeld.model import contacts, se2
from taxeld.proposals import bundle
from taxeld.stream import client, messages
from taxeld_hil.rig.ledger import Unit
from taxeld_hil.rig.ports import SlcanPort
from taxeld_protocol import cyskin
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import Answer, VirtualIhb

SKIN = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
LARGE = "cylinder:rows=5,columns=128,radius_m=0.04,pitch_m=0.015"  # 640 taxels
FULL_SCALE, IDLE_COUNTS, NOISE = 20_000.0, 10_000.0, 34.0
POSE_S = 0.01
SETTLE_S = 4.0  # the baseline, and the first touches
ROLL_HZ, PRESS_HZ = 0.13, 0.31
DEPTH_M = (0.0015, 0.0045)
SCAN_S, WAKES = 0.05, 2  # times that it is woken for a scan
EMPTY = """
import sys, time, zmq
poses = zmq.Context().socket(zmq.SUB)
poses.subscribe(b"")
poses.connect(sys.argv[1])
every_s, until = float(sys.argv[2]), time.monotonic() + float(sys.argv[3])
spent_s, due = time.process_time(), time.monotonic()
while due < until:
    due += every_s
    time.sleep(max(0.0, due - time.monotonic()))
    while poses.getsockopt(zmq.EVENTS) & zmq.POLLIN:
        poses.recv_multipart()
print(100.0 * (time.process_time() - spent_s) / float(sys.argv[3]))
"""
Row = tuple[str, float, float | None]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="a case of CPU time")
    parser.add_argument("--long", type=float, default=0.0, help="minutes at 200 Hz")
    parser.add_argument("--ticks", type=int, default=0, help="on a fake clock, for the memory")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = [*rows(args.seconds)]
    found += long(args.long) if args.long else []
    found += flat(args.ticks) if args.ticks else []
    for name, value, budget in found:
        print(f"{name:60s} {value:10.3f} {'' if budget is None else f'{budget:8.2f}'}", flush=True)
    if args.json:
        lines = [dict(zip(("figure", "measured", "budget"), row, strict=True)) for row in found]
        args.json.write_text(json.dumps(lines, indent=1) + "\n", encoding="utf-8")
    return 0


def rows(seconds: float = 20.0) -> list[Row]:
    """The share of a core, the path's time, the start and the memory."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        large = _large_bundle(place / "large")
        touched = measure(Case(SKIN, "box", touched=True), seconds, place)
        idle = measure(Case(SKIN, "box", touched=False), seconds, place)
        recording = measure(Case(SKIN, "box", touched=False, record=True), seconds, place)
        fast = measure(Case(SKIN, "box", touched=True, rate_hz=200.0), seconds, place)
        wide = measure(Case(LARGE, str(large), touched=True), seconds, place)
    return [
        ("a core's share, 80 taxels, touched all the time: %", touched.cpu_percent, 6.0),
        ("  … scans with contact that were learned from, a second", touched.updates_hz, None),
        ("a core's share, untouched: %", idle.cpu_percent, 2.0),
        ("  … the same wake-ups and poses, and no work: %", empty_percent(seconds), None),
        ("  … and recorded: %", recording.cpu_percent, None),
        ("a core's share, 640 taxels, touched all the time: %", wide.cpu_percent, 10.0),
        ("a scan's way through the loop, median: ms", touched.p50_ms, 2.0),
        ("a scan's way through the loop, 99 %: ms", touched.p99_ms, 5.0),
        *(
            (f"a scan's last frame to its estimate, {case}, {figure}: ms", value, budget)
            for case, ran in (("untouched", idle), ("touched", touched), ("… at 200 Hz", fast))
            for figure, value, budget in (
                ("median", ran.reached_p50_ms, 1.5),
                ("99 %", ran.reached_p99_ms, 5.0),
            )
        ),
        ("  … touched, of scans that brought samples, median: ms", touched.sampled_p50_ms, None),
        ("touches served below the chosen sampler", touched.degraded, None),
        ("start to ready: CPU s", idle.start_cpu_s, 0.5),
        ("resident memory: MB", touched.resident_mb, 90.0),
    ]


def empty_percent(seconds: float) -> float:
    """A core's share of a process that wakes as often as an untouched daemon, takes the robot's
    poses as they are, and does nothing."""
    with (
        tempfile.TemporaryDirectory() as place,
        zmq.Context() as context,
        context.socket(zmq.PUB) as poses,
    ):
        poses.linger = 0
        poses.bind(f"ipc://{place}/poses")
        arguments = (f"ipc://{place}/poses", str(SCAN_S / WAKES), str(seconds))
        command = [sys.executable, "-c", EMPTY, *arguments]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            while process.poll() is None:
                poses.send_multipart((messages.SENSOR_POSE, bytes(40), b"0"), zmq.NOBLOCK)
                time.sleep(POSE_S)
            assert process.stdout is not None
            return float(process.stdout.read())


def long(minutes: float) -> list[Row]:
    """At 200 Hz, touched all the time; beside it what the machine does to any such loop."""
    case = Case(SKIN, "box", touched=True, rate_hz=200.0)
    with tempfile.TemporaryDirectory() as place:
        ran = measure(case, 60.0 * minutes, Path(place))
    found: list[Row] = [
        (f"{minutes:g} minutes at 200 Hz: overruns of its own", ran.own_overruns, 0.0),
        ("  … ticks missed, for whatever reason", ran.overruns, None),
        ("  … touches served below the chosen sampler", ran.degraded, None),
        ("  … a scan's way, 99 %: ms", ran.p99_ms, 5.0),
        ("  … and longest: ms", ran.max_ms, None),
        ("  … growth of resident memory: MB", ran.grown_mb, 1.0),
    ]
    if shutil.which("cyclictest"):
        with tempfile.TemporaryDirectory() as place:
            out = Path(place) / "cyclictest.json"
            command = ["cyclictest", "-q", "-p", "20", "-i", "5000", "-D", "60", "--json", str(out)]
            done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
            if done.returncode == 0:
                thread = json.loads(out.read_text(encoding="utf-8"))["thread"]["0"]
                found.append(("  … cyclictest's longest delay here: ms", thread["max"] / 1e3, None))
    return found


def flat(ticks: int) -> list[Row]:
    """Growth of the process between a tenth of the ticks and all, a scan every fifth tick."""
    return [(f"growth over {ticks} ticks on a fake clock: MB", memory.grown_mb(ticks), 1.0)]


@dataclass(frozen=True)
class Case:
    layout: str
    bundle: str
    touched: bool
    rate_hz: float = 100.0
    particles_max: int = 100  # of N = 100; while the belief is wide, the default is more
    record: bool = False


@dataclass(frozen=True)
class Measured:
    cpu_percent: float
    updates_hz: float
    reached_p50_ms: float  # from a scan's last frame to the subscriber of its estimate
    reached_p99_ms: float
    sampled_p50_ms: float  # of those that brought samples of their own; 0 where none did
    p50_ms: float
    p99_ms: float
    max_ms: float
    start_cpu_s: float
    resident_mb: float
    grown_mb: float
    own_overruns: int
    overruns: int
    degraded: int


def measure(case: Case, seconds: float, place: Path) -> Measured:
    """Run the daemon on the case; what it took between settling and the end."""
    skin = layouts.load(case.layout)
    loaded = bundle.load(case.bundle, skin, 0.005)
    hub = VirtualIhb(wired(skin.uid.tolist()))
    with (
        tempfile.TemporaryDirectory(dir=place) as name,
        closing(SlcanPort(Path(name) / "skin", lambda _: None)) as port,
        zmq.Context() as context,
        context.socket(zmq.PUB) as poses,
        context.socket(zmq.SUB) as estimates,
    ):
        here = Path(name)
        poses.linger = 0
        poses.bind(f"ipc://{here}/poses")
        estimates.linger = 0
        estimates.subscribe(messages.ESTIMATE)
        estimates.connect(f"ipc://{here}/stream")
        with _daemon(case, here) as (pid, ready):
            robot = Robot(loaded, case.touched, hub, port, poses, estimates)
            robot.serve_until(ready)
            start_cpu_s = _cpu_s(pid)
            with streams.connected(streams.CLIENTS["one subscriber of all"], str(here)):
                robot.serve(SETTLE_S)
                before = _health(here, robot)
                cpu_s, resident_mb = _cpu_s(pid), _resident_mb(pid)
                robot.reached_s.clear()
                robot.sampled_s.clear()
                robot.serve(seconds)
                reached_ms = 1e3 * np.array(robot.reached_s)
                sampled_ms = 1e3 * np.array(robot.sampled_s or [0.0])
                spent_s, grown_mb = _cpu_s(pid) - cpu_s, _resident_mb(pid) - resident_mb
                after = _health(here, robot)
    total, loop = after["lat_us"]["total"], after["loop"]
    took_s = after["uptime_s"] - before["uptime_s"]
    updates = after["estimator"]["updates"] - before["estimator"]["updates"]
    served = after["degraded"]
    return Measured(
        cpu_percent=100.0 * spent_s / seconds,
        updates_hz=updates / took_s,
        reached_p50_ms=float(np.percentile(reached_ms, 50)),
        reached_p99_ms=float(np.percentile(reached_ms, 99)),
        sampled_p50_ms=float(np.median(sampled_ms)),
        p50_ms=total["p50"] / 1e3,
        p99_ms=total["p99"] / 1e3,
        max_ms=total["max"] / 1e3,
        start_cpu_s=start_cpu_s,
        resident_mb=resident_mb + grown_mb,
        grown_mb=grown_mb,
        own_overruns=loop["own_overruns"],
        overruns=loop["overruns"],
        degraded=sum(served.values()) - served["chosen"],
    )


class Robot:
    """A box that rolls along the skin, or stays away from it, and the hub that feels it."""

    def __init__(
        self,
        loaded: bundle.Bundle,
        touched: bool,
        hub: VirtualIhb,
        port: SlcanPort,
        poses: zmq.Socket[bytes],
        estimates: zmq.Socket[bytes] | None = None,
    ) -> None:
        """`estimates`: hears those of the daemon, whose delay is measured."""
        self.reached_s: list[float] = []  # from a scan's last frame to its first estimate
        self.sampled_s: list[float] = []  # the same, of those in which samples are
        self._listening = [] if estimates is None else [estimates]
        self._sent_s = self._heard_t = 0.0
        self._model, self._touched = loaded.model, touched
        self._hub, self._port, self._poses = hub, port, poses
        self._rng = np.random.default_rng(0)
        made = contacts.synthesise(
            self._model.scene, self._model.layout.radius_m, 0.005, 500, self._rng
        ).pose
        self._seen = made[np.argmax(self._model.activation(made).max(axis=1))]
        self._towards = self._seen[:2] / np.linalg.norm(self._seen[:2])
        index = {int(uid): i for i, uid in enumerate(self._model.layout.uid)}
        uids = [uid for module in hub.modules for uid in module.uids]
        self._taxel = np.array([index.get(uid, -1) for uid in uids])
        self._next_pose_s = self._began = time.monotonic()

    def begin(self) -> None:
        """The motion begins anew."""
        self._began = time.monotonic()

    def serve(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._step()

    def serve_until(self, ready: socket.socket) -> None:
        deadline = time.monotonic() + 30.0
        while not select.select([ready], [], [], 0)[0]:
            assert time.monotonic() < deadline, "the daemon was never ready"
            self._step()

    def _step(self) -> None:
        select.select([self._port, *self._listening], [], [], 0.002)
        for stream in self._listening:
            self._hear(stream)
        now, wall = time.monotonic(), time.time()
        for packet in self._port.take(wall):
            self._send(self._hub.answer(packet))
        yaw, deeper_m = self._at(now - self._began)
        if now >= self._next_pose_s:
            self._next_pose_s = max(self._next_pose_s + POSE_S, now)
            x, y = self._towards * deeper_m
            body = msgpack.packb({"t": wall, "x": float(x), "y": float(y), "theta": yaw})
            self._poses.send_multipart((messages.SENSOR_POSE, body, b"%.6f" % wall), zmq.NOBLOCK)
        if self._hub.due(now):
            counts = self._counts(np.array([*(self._towards * deeper_m), yaw]))
            self._send(self._hub.sensor_data(counts))
            self._sent_s = time.monotonic()
        self._port.flush()

    def _hear(self, stream: zmq.Socket[bytes]) -> None:
        while int(stream.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            estimate = msgpack.unpackb(stream.recv_multipart()[1])
            if estimate["t"] > self._heard_t and self._sent_s:
                self._heard_t = estimate["t"]
                self.reached_s.append(time.monotonic() - self._sent_s)
                self.sampled_s += self.reached_s[-1:] * (estimate["injected"] > 0)
                self._sent_s = 0.0

    def _send(self, answers: Iterable[Answer]) -> None:
        for command, payload in answers:
            for frame in cyskin.to_frames(command, payload, ihb=self._hub.short_id, t=0.0):
                if self._port.is_open:
                    self._port.send(Unit(frame, None))

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
def _daemon(case: Case, place: Path) -> Iterator[tuple[int, socket.socket]]:
    """`taxeld run`: its process and the socket on which it says that it is ready."""
    settings = place / "config.toml"
    settings.write_text(
        f'[skin]\nlayout = "{case.layout}"\nfull_scale_counts = {FULL_SCALE}\n'
        f'[source]\nkind = "serial"\nframing = "slcan"\nchannel = "{place}/skin"\n'
        f'[scene]\nbundle = "{case.bundle}"\n[sensor_pose]\nendpoint = "ipc://{place}/poses"\n'
        f"[loop]\nrate_hz = {case.rate_hz}\n[filter]\nparticles_max = {case.particles_max}\n"
        f"[budget]\nfilter_ms = {min(5.0, 500.0 / case.rate_hz)}\n"
        f'[publish]\nendpoints = ["ipc://{place}/stream"]\n'
        f'[control]\nendpoint = "ipc://{place}/control"\n',
        encoding="utf-8",
    )
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
        ready.bind(str(place / "notify"))
        environ = {
            **os.environ,
            "NOTIFY_SOCKET": str(place / "notify"),
            "PYTHONDONTWRITEBYTECODE": "",  # it starts as installed, from the second time on
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


def _health(place: Path, robot: Robot) -> dict:
    """The daemon's health, not older than a second."""
    robot.serve(1.1)
    answer = client.ask(f"ipc://{place}/control", "status", timeout_s=5.0)
    assert answer is not None
    return answer["health"]


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    found = re.search(r"VmRSS:\s+(\d+)", text)
    assert found
    return int(found[1]) / 1024.0


def _large_bundle(path: Path) -> Path:
    """The shipped box for a skin of as many rows but eight times the columns: by the table, as its
    samplers are of their own skin."""
    shutil.copytree(bundle.find("box"), path)
    info = json.loads((path / "bundle.json").read_text(encoding="utf-8"))
    large = layouts.load(LARGE)
    info["layout"] = {**info["layout"], "name": large.name, "digest": large.digest}
    info["samplers"], info["auto"] = [], ["table"]
    (path / "bundle.json").write_text(json.dumps(info), encoding="utf-8")
    return path


if __name__ == "__main__":
    sys.exit(main())
