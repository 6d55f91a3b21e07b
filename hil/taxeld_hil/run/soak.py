"""`taxeld-hil soak`: random faults from a seed, for hours of scans, on one daemon.

Lap follows lap: the daemon keeps its counters and its memory, and with each lap the object stands
elsewhere and is looked for anew. The report is written as it goes; a soak that was cut short goes
on at its next lap, with another daemon.
"""

import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from taxeld.errors import SetupError
from taxeld_hil.grade.grade import Grade
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.run.live import LiveRun
from taxeld_hil.scenario import laps
from taxeld_hil.scenario.scenario import Scenario

REPORT_EVERY = 20  # laps
FAILURES_KEPT = 50
SETTLED_LAPS = 30  # memory is compared from here on: caches have filled
GROWTH_MAX_MB = 8.0
RIGHT_MM = 10.0
RATE_HZ = 40.0  # ticks on the fake clock, where none is late
Say = Callable[[str], None]


@dataclass(slots=True)
class Soak:
    """What has been seen so far."""

    seed: int
    clock: str
    object: str  # bundle
    physics: str  # of the skin
    hours: float  # asked for
    laps: int = 0
    hours_done: float = 0.0
    daemons: int = 0  # that were started
    scans_sent: int = 0
    units: int = 0  # frames delivered
    injected: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)  # windows, by kind
    found: int = 0  # laps that ended converged and right
    full: int = 0  # laps in which the daemon felt as many contacts as there were,
    full_found: int = 0  # and found the object
    full_right: int = 0  # of these laps, those whose last estimate was valid and right
    lost_laps: list[int] = field(default_factory=list)  # and did not
    silent_episodes: int = 0
    silent_worst_mm: float = 0.0
    silent_laps: list[int] = field(default_factory=list)
    silent_after: Counter[str] = field(default_factory=Counter)  # the fault that explains it
    unexplained_before: int = 0  # of the daemons before this one
    unexplained: int = 0  # frames, packets, scans and poses that the daemon has not accounted for
    flags_missed: Counter[str] = field(default_factory=Counter)
    worst_detection_s: dict[str, float] = field(default_factory=dict)
    worst_recovery_s: dict[str, float] = field(default_factory=dict)
    doubted: Counter[str] = field(default_factory=Counter)  # INCONSISTENT or BLIND for long after
    not_recovered: Counter[str] = field(default_factory=Counter)
    rss_mb: list[tuple[float, float]] = field(default_factory=list)  # hour, resident memory
    failures: list[str] = field(default_factory=list)
    cpu_s: float = 0.0

    @property
    def growth_mb(self) -> float:
        """Of memory, from the median of the first third to that of the last."""
        values = [mb for _, mb in self.rss_mb]
        third = max(len(values) // 3, 1)
        return _median(values[-third:]) - _median(values[:third]) if values else 0.0

    @property
    def passed(self) -> bool:
        """Nothing unaccounted for, all recovered, memory flat; and no silent failure but after
        faults that look like a touch elsewhere."""
        return (
            not self.silent_after - Counter(dict.fromkeys(laps.MISLEADING, self.laps))
            and self.unexplained == 0
            and not self.not_recovered
            and self.growth_mb < GROWTH_MAX_MB
        )

    def add(self, number: int, grade: Grade, seconds: float) -> None:
        """Add the grade of a lap that took so many seconds of scenario time."""
        figures = grade.figures
        self.laps = number + 1
        self.hours_done += seconds / 3600.0
        silent = figures["silent_failures"]
        self.silent_episodes += silent["episodes"]
        self.silent_worst_mm = max(self.silent_worst_mm, silent["worst_mm"])
        if silent["episodes"]:
            self.silent_laps.append(number)
        for at_s in silent["at_s"]:
            begun = [row["kind"] for row in figures["faults"] if row["at_s"] <= at_s]
            self.silent_after[_explains(begun)] += 1
        error = figures["error_mm"]
        right = error is not None and error < RIGHT_MM
        found = figures["status"] == "converged" and right
        self.found += found
        if figures["contacts"] >= laps.CONTACTS:
            self.full += 1
            self.full_found += found
            self.full_right += right
            if not found:
                self.lost_laps.append(number)
        gaps = (abs(law["expected"] - law["counted"]) - law["slack"] for law in figures["laws"])
        self.unexplained = self.unexplained_before + sum(max(gap, 0) for gap in gaps)
        for row in figures["faults"]:
            self._add_fault(row)
        for check in grade.checks:
            if check.passed is False and len(self.failures) < FAILURES_KEPT:
                self.failures.append(f"lap {number}: {check.name}: {check.detail}")

    def _add_fault(self, row: dict[str, Any]) -> None:
        kind = row["kind"]
        if not row["injected"]:
            return
        self.faults[kind] += 1
        if row["flag"] is not None:
            late = row["detected_s"] is None or row["detected_s"] > row["within_s"]
            self.flags_missed[kind] += late
            _worst(self.worst_detection_s, kind, row["detected_s"])
        if not row["overlapped"]:
            _worst(self.worst_recovery_s, kind, row["recovered_s"])
            if row["doubted"]:
                self.doubted[kind] += 1
            elif row["recovered_s"] is None:
                self.not_recovered[kind] += 1

    def write(self, path: Path) -> None:
        seen = {spec.name: getattr(self, spec.name) for spec in fields(self)}
        text = json.dumps({**seen, "growth_mb": self.growth_mb, "passed": self.passed}, indent=1)
        path.write_text(text + "\n", encoding="utf-8")

    def line(self) -> str:
        """Progress in short."""
        rss = self.rss_mb[-1][1] if self.rss_mb else 0.0
        return (
            f"{self.hours_done:6.2f} of {self.hours:g} h, lap {self.laps}, "
            f"{sum(self.faults.values())} faults, found {self.found}, "
            f"of {self.full} with all contacts {self.full_found}, "
            f"silent {self.silent_episodes}, unexplained {self.unexplained}, "
            f"worst recovery {max(self.worst_recovery_s.values(), default=0.0):.2f} s, "
            f"{rss:.0f} MB"
        )


COUNTERS = ("injected", "faults", "flags_missed", "doubted", "not_recovered", "silent_after")


def resumed(path: Path, base: Scenario, seed: int, clock: str, hours: float) -> Soak:
    """The soak that a report holds, if it is one of this seed, clock, object and skin that is not
    over.

    Raises:
        SetupError: there is a file that is no report.
    """
    asked = seed, clock, base.bundle, base.physics
    if path.is_file():
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            same = tuple(data.pop(key) for key in ("seed", "clock", "object", "physics")) == asked
            done = data["hours_done"] >= hours
        except (ValueError, KeyError, TypeError, AttributeError):
            raise SetupError(f"{path}: is no report of a soak; name another file") from None
        if same and not done:
            if "full_right" not in data:
                raise SetupError(f"{path}: is of an older kind; name another file")
            del data["growth_mb"], data["passed"], data["hours"]
            data["unexplained_before"] = data["unexplained"]
            for name in COUNTERS:
                data[name] = Counter(data[name])
            return Soak(*asked, hours, **data)
    return Soak(*asked, hours)


def soak_fake(base: Scenario, soak: Soak, path: Path, say: Say) -> Soak:
    """On the fake clock, as fast as it goes."""
    run: FakeRun | None = None
    units = scans = 0
    while soak.hours_done < soak.hours:
        began = time.process_time()
        number = soak.laps
        scenario = laps.lap(base, soak.seed, number)
        seed = soak.seed + number
        if run is None:
            run = FakeRun(scenario, seed, rate_hz=RATE_HZ)
            soak.daemons += 1
        else:
            run.lap(scenario, seed)
        ledger = run.rig.ledger
        ledger.done.clear()
        soak.add(number, run.graded(f"lap {number}"), run.line.t)
        soak.injected.update(ledger.done)
        soak.units += ledger.fates.units - units
        soak.scans_sent += ledger.scans_sent - scans
        units, scans = ledger.fates.units, ledger.scans_sent
        soak.cpu_s += time.process_time() - began
        if soak.laps % REPORT_EVERY == 0:
            if soak.laps > SETTLED_LAPS:
                soak.rss_mb.append((round(soak.hours_done, 3), resident_mb("self")))
            soak.write(path)
            say(soak.line())
    soak.write(path)
    return soak


def lap_alone(base: Scenario, seed: int, number: int) -> Grade:
    """A lap of a soak on the fake clock, of the same skin and object, on a daemon of its own."""
    run = FakeRun(laps.lap(base, seed, 0), seed, rate_hz=RATE_HZ)
    if number:
        run.lap(laps.lap(base, seed, number), seed + number)
    return run.graded(f"lap {number}")


def soak_live(base: Scenario, soak: Soak, path: Path, say: Say) -> Soak:
    """In real time, over the scenario's transport.

    Raises:
        SetupError: a process failed.
    """
    kinds = (*laps.KINDS, "subscriber_dead")
    with tempfile.TemporaryDirectory(prefix="taxeld-") as temporary:
        place = Path(temporary)
        first = laps.lap(base, soak.seed, soak.laps, kinds)
        run = LiveRun("soak", first, soak.seed + soak.laps, place / "session", "", _silence)
        with run.opened(place) as bench:
            soak.daemons += 1
            ledger = bench.rig.ledger
            while soak.hours_done < soak.hours:
                number, sent, units = soak.laps, ledger.scans_sent, ledger.fates.units
                scenario = laps.lap(base, soak.seed, number, kinds)
                ledger.done.clear()
                lap = run.lap(bench, f"lap {number}", scenario, soak.seed + number)
                soak.add(number, lap, bench.rig.duration_s)
                soak.injected.update(ledger.done)
                soak.scans_sent += ledger.scans_sent - sent
                soak.units += ledger.fates.units - units
                soak.rss_mb.append(
                    (round(soak.hours_done, 3), resident_mb(run.processes.daemon.pid))
                )
                soak.write(path)
                say(soak.line())
            gaps = (abs(law.expected - law.counted) - law.slack for law in run.settled(bench))
            soak.unexplained = soak.unexplained_before + sum(max(gap, 0) for gap in gaps)
    soak.write(path)
    return soak


def resident_mb(pid: int | str) -> float:
    """Resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) / 1024.0


def _silence(_: str) -> None:
    """The contacts of a soak are not printed."""


def _explains(begun: list[str]) -> str:
    """Of the faults that have begun in a lap, the one that a silent failure is put down to: the
    last that misleads, as the daemon remembers what it was made to believe; else the last."""
    lies = [kind for kind in begun if kind in laps.MISLEADING]
    return (lies or begun or ["none"])[-1]


def _worst(worst: dict[str, float], kind: str, seconds: float | None) -> None:
    if seconds is not None:
        worst[kind] = round(max(worst.get(kind, 0.0), seconds), 3)


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]
