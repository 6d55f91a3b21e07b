"""What a viewer costs the daemon: its CPU time with one and without, in turns, and ticks lost.

    python benchmarks/view.py [--seconds 20] [--pairs 8] [--of view watch ros2]

One daemon, touched all the time (benchmarks/service.py), with nobody listening and with a viewer,
each for so many seconds and over the same motion; who begins changes from pair to pair. CPU time is
that of all the daemon's threads, by the kernel's account in nanoseconds; the interval is that of
the mean difference of the pairs, 95 %. The viewers draw: `view` into a file, `watch` on a terminal
of 80 by 24, `ros2` for a domain in which nobody reads. The skin and the robot, which are hardware
elsewhere, have a real-time priority where that is permitted.
"""

import argparse
import contextlib
import fcntl
import os
import pty
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

import numpy as np
import zmq
from scipy import stats

import service
from service import SKIN, Case, Robot
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld_hil.rig.ports import SlcanPort
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

CONVERGE_S = 20.0
SETTLE_S = 4.0  # of a viewer that has come: its first drawing is its largest
LOOK_S, PATIENCE_S = 0.1, 60.0
PRIORITY = 10  # below the daemon's
VIEWERS: dict[str, tuple[str, ...]] = {
    "view": ("taxeld.cli", "view", "--save", "{place}/run.rrd", "--endpoint"),
    "watch": ("taxeld.cli", "watch", "--endpoint"),
    "ros2": ("taxeld_ros2.cli", "--stream"),
}
LOOPBACK = "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast></General></Domain></CycloneDDS>"  # noqa: E501


@dataclass(frozen=True)
class Span:
    """Some seconds of the daemon's life."""

    share: float  # of a core, %
    overruns: int
    own_overruns: int
    viewer: float = 0.0  # the viewer's share, %


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--pairs", type=int, default=8)
    parser.add_argument("--of", nargs="+", choices=VIEWERS, default=list(VIEWERS))
    args = parser.parse_args()
    with contextlib.suppress(PermissionError):
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    for viewer in args.of:
        alone, seen = measure(viewer, args.seconds, args.pairs)
        tell(viewer, alone, seen)
    return 0


def tell(viewer: str, alone: list[Span], seen: list[Span]) -> None:
    without, with_ = (np.array([span.share for span in spans]) for spans in (alone, seen))
    added = with_ - without
    half = stats.t.ppf(0.975, len(added) - 1) * added.std(ddof=1) / np.sqrt(len(added))
    print(
        f"{viewer}: daemon {without.mean():.2f} % of a core alone, {with_.mean():.2f} % with it; "
        f"added {added.mean():+.2f} ({added.mean() - half:+.2f} .. {added.mean() + half:+.2f}) %, "
        f"{len(added)} pairs"
    )
    for name, spans in (("alone", alone), ("with it", seen)):
        own, lost = sum(s.own_overruns for s in spans), sum(s.overruns for s in spans)
        print(f"  {name}: overruns of its own {own}, ticks missed for whatever reason {lost}")
    share = np.mean([span.viewer for span in seen])
    print(f"  the viewer itself: {share:.1f} % of a core", flush=True)


def measure(viewer: str, seconds: float, pairs: int) -> tuple[list[Span], list[Span]]:
    """Spans with nobody there, and with the viewer."""
    skin = layouts.load(SKIN)
    loaded = bundle.load("box", skin, 0.005)
    hub = VirtualIhb(wired(skin.uid.tolist()))
    alone: list[Span] = []
    seen: list[Span] = []
    with (
        tempfile.TemporaryDirectory() as name,
        tempfile.TemporaryDirectory(dir=name) as here,
        contextlib.closing(SlcanPort(Path(here) / "skin", lambda _: None)) as port,
        zmq.Context() as context,
        context.socket(zmq.PUB) as poses,
    ):
        poses.linger = 0
        poses.bind(f"ipc://{here}/poses")
        with service._daemon(Case(SKIN, "box", touched=True), Path(here)) as (pid, ready):
            robot = Robot(loaded, True, hub, port, poses)
            robot.serve_until(ready)
            daemon = Watched(pid, Path(here), robot)
            robot.serve(CONVERGE_S)
            for pair in range(pairs):
                turns: list[Callable[[], None]] = [
                    lambda: alone.append(daemon.span(seconds)),
                    lambda: seen.append(daemon.seen(viewer, seconds)),
                ]
                for turn in turns if pair % 2 else reversed(turns):
                    turn()
    return alone, seen


class Watched:
    """The daemon, its robot, and who looks at it."""

    def __init__(self, pid: int, here: Path, robot: Robot) -> None:
        self._pid, self._here, self._robot = pid, here, robot

    def span(self, seconds: float, viewer: int = 0) -> Span:
        before = service._health(self._here, self._robot)["loop"]
        self._robot.begin()
        begun, spent, drawn = time.monotonic(), cpu_s(self._pid), cpu_s(viewer)
        self._robot.serve(seconds)
        took = (time.monotonic() - begun) / 100.0
        spent, drawn = cpu_s(self._pid) - spent, cpu_s(viewer) - drawn
        after = service._health(self._here, self._robot)["loop"]
        lost, own = (after[key] - before[key] for key in ("overruns", "own_overruns"))
        return Span(spent / took, lost, own, drawn / took)

    def seen(self, viewer: str, seconds: float) -> Span:
        there = self._subscriptions()
        with looking(viewer, self._here, self._robot) as process:
            deadline = time.monotonic() + PATIENCE_S
            while self._subscriptions() <= there:
                assert process.poll() is None, f"{viewer} ended"
                assert time.monotonic() < deadline, f"{viewer} never came"
            self._robot.serve(SETTLE_S)
            span = self.span(seconds, process.pid)
            assert process.poll() is None, f"{viewer} ended"
        deadline = time.monotonic() + PATIENCE_S
        while self._subscriptions() > there:
            assert time.monotonic() < deadline, "the daemon did not let it go"
        return span

    def _subscriptions(self) -> int:
        counted = service._health(self._here, self._robot)["subscribers"]
        return int(counted["joined"] - counted["left"])


@contextlib.contextmanager
def looking(viewer: str, here: Path, robot: Robot) -> Iterator["subprocess.Popen[bytes]"]:
    """The viewer at work, on a terminal of its own; the robot goes on while it ends."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    module, *arguments = (part.format(place=here) for part in VIEWERS[viewer])
    command = [sys.executable, "-m", module, *arguments, f"ipc://{here}/stream"]
    environ = {**os.environ, "TERM": "xterm-256color", "CYCLONEDDS_URI": LOOPBACK}
    process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environ)
    os.close(theirs)
    reader = Thread(target=drain, args=(ours,), daemon=True)
    reader.start()
    try:
        yield process
    finally:
        process.terminate()
        while process.poll() is None:
            robot.serve(LOOK_S)
        reader.join()
        os.close(ours)


def drain(terminal: int) -> None:
    try:
        while os.read(terminal, 65536):
            pass
    except OSError:  # nobody writes any more
        return


def cpu_s(pid: int) -> float:
    """Of all threads that live, in nanoseconds' steps; 0 of no process."""
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat") if pid else ()
    return sum(int(task.read_text(encoding="ascii").split()[0]) for task in tasks) / 1e9


if __name__ == "__main__":
    sys.exit(main())
