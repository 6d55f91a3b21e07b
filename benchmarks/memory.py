"""A whole daemon on a fake clock, touched over and over: how much its memory grows."""

import math
import resource
import tempfile
from dataclasses import replace
from pathlib import Path

import streams
from fake_time import EPOCH_S, FakeTime
from taxeld.service import realtime
from taxeld.service.loop import Daemon
from taxeld.source import session
from taxeld.source.sources import SourceCounters
from taxeld.source.wire import Wire
from taxeld.stream.pose_input import OnPose
from taxeld_protocol.decoder import Scan

TICK_S = 0.01


class Again:
    """A session without end: its scans and poses anew, one lap after another."""

    finished = False

    def __init__(self, place: Path, wire: Wire, on_pose: OnPose, clock: FakeTime) -> None:
        self.wire, self.counters = wire, SourceCounters()
        self._clock, self._on_pose = clock, on_pose
        items, self._poses = (recorded := session.read(place)).items, recorded.poses
        self._t0 = self._poses[0][0]
        self._scans = [
            scan for item in items for heard in wire.take(item, item.t) for scan in heard.scans
        ]
        self._lap = self._scan = self._pose = 0

    def poll(self, now_s: float) -> list[Scan]:
        lap_s = self._poses[-1][0] - self._t0 + 1.0
        lap, into_s = divmod(now_s, lap_s)
        if lap != self._lap:
            self._lap, self._scan, self._pose = lap, 0, 0
        by = EPOCH_S + lap * lap_s - self._t0
        while self._pose < len(self._poses) and self._poses[self._pose][0] - self._t0 <= into_s:
            t, *pose = self._poses[self._pose]
            self._on_pose(t + by, *pose, math.inf)
            self._pose += 1
        found = []
        while self._scan < len(self._scans) and self._scans[self._scan].t - self._t0 <= into_s:
            scan = self._scans[self._scan]
            found.append(replace(scan, t=scan.t + by))
            self._scan += 1
        return found

    def clock_stepped(self, by: float) -> None:
        """The fake clock is never set."""

    def close(self) -> None:
        """Nothing is held open."""


def grown_mb(ticks: int) -> float:
    """Growth of this process between a tenth of the ticks and all of them [MB]."""
    clock = FakeTime()
    with tempfile.TemporaryDirectory() as place, clock.installed():
        streams.record(Path(place))
        daemon = Daemon(streams.setting(place)[0])
        clock.give(daemon)
        daemon.source = Again(Path(place), daemon.source.wire, daemon.pipeline.poses.add, clock)
        before = 0
        with realtime.thread(0):
            for tick in range(ticks):
                clock.now_s = tick * TICK_S
                daemon.tick(clock.now_s)
                if tick == ticks // 10:
                    before = resident_kb()
        after = resident_kb()
        daemon.close()
    assert daemon.counters.scans > ticks // 8
    assert daemon.pipeline.estimator.counters.updates > ticks // 200
    return (after - before) / 1024.0


def resident_kb() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() // 1024
