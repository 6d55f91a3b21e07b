"""`taxeld-hil soak`: random faults from a seed, for hours of scans, on one daemon.

Lap follows lap: the daemon keeps its counters and its memory, and with each lap the object stands
elsewhere and is looked for anew. The report is written as it goes; a soak that was cut short goes
on at its next lap, with another daemon.
"""

import json
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from statistics import median_high
from typing import Any

from taxeld.errors import SetupError
from taxeld_hil.grade.grade import Grade
from taxeld_hil.integrity import Stanford, is_found
from taxeld_hil.jobs import layout_name
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.run.listener import Say
from taxeld_hil.run.live import LiveRun
from taxeld_hil.scenario import laps
from taxeld_hil.scenario.scenario import Scenario

REPORT_EVERY = 20  # laps on the fake clock; in real time every lap is reported
ASKED = "seed", "clock", "object", "physics", "layout", "faultless", "learns"  # of a soak
FAILURES_KEPT = 50
SETTLED_LAPS = 30  # on the fake clock memory is compared from here on: caches have filled
GROWTH_MAX_MB = 8.0
RATE_HZ = 40.0  # ticks on the fake clock, where none is late


@dataclass(slots=True)
class Soak:
    """Everything that has been seen so far."""

    seed: int
    clock: str
    hours: float  # asked for
    object: str = ""  # bundle
    physics: str = ""  # name of the skin
    layout: str = ""  # its name; empty: what the bundle was built for
    faultless: bool = False
    learns: bool = True  # whether the daemon learns how taxels respond
    laps: int = 0
    hours_done: float = 0.0
    daemons: int = 0  # number of daemons started
    scans_sent: int = 0
    units: int = 0  # frames delivered
    faults: Counter[str] = field(default_factory=Counter)  # windows, by kind
    found: int = 0  # laps whose last estimate was valid and had found the object
    found_and_sure: int = 0
    full: int = 0  # laps in which the daemon felt as many contacts as there were
    full_found: int = 0
    full_found_and_sure: int = 0
    lost_laps: list[int] = field(default_factory=list)  # full laps that were not found and sure
    misleading_laps: list[int] = field(default_factory=list)
    misleading_after: Counter[str] = field(default_factory=Counter)  # the fault that explains it
    stanford: Stanford = field(default_factory=Stanford)  # of the estimates after each contact
    unexplained_before: int = 0  # units unexplained of earlier daemons
    unexplained: int = 0  # frames, packets, scans and poses that the daemon has not accounted for
    flags_missed: Counter[str] = field(default_factory=Counter)
    worst_recovery_s: dict[str, float] = field(default_factory=dict)
    doubted: Counter[str] = field(default_factory=Counter)  # INCONSISTENT or BLIND for long after
    not_recovered: Counter[str] = field(default_factory=Counter)
    rss_mb: list[tuple[float, float]] = field(default_factory=list)  # hour, resident memory
    failures: list[str] = field(default_factory=list)
    cpu_s: float = 0.0

    @property
    def growth_mb(self) -> float:
        """Growth of memory, from the median of the first third to the median of the last."""
        values = [mb for _, mb in self.rss_mb]
        third = max(len(values) // 3, 1)
        return median_high(values[-third:]) - median_high(values[:third]) if values else 0.0

    @property
    def passed(self) -> bool:
        """Nothing unaccounted for, all recovered, memory flat; and nothing misleading but after
        faults that look like a touch elsewhere."""
        return (
            self.misleading_after.keys() <= {*laps.DECEPTIVE}
            and self.unexplained == 0
            and not self.not_recovered
            and self.growth_mb < GROWTH_MAX_MB
        )

    def add(self, number: int, grade: Grade, seconds: float) -> None:
        """Add the grade of a lap that took so many seconds of scenario time."""
        figures = grade.figures
        self.laps = number + 1
        self.hours_done += seconds / 3600.0
        misleading_at_s = figures["misleading"]["at_s"]
        self.misleading_laps += [number] * bool(misleading_at_s)
        for at_s in misleading_at_s:
            begun = [row["kind"] for row in figures["faults"] if row["at_s"] <= at_s]
            # the daemon remembers what a deceptive fault made it believe
            deceived = [kind for kind in begun if kind in laps.DECEPTIVE]
            self.misleading_after[(deceived or begun or ["none"])[-1]] += 1
        self.stanford.include(Stanford.of_row(figures["stanford"]))
        found = figures["error_mm"] is not None and bool(is_found(figures["error_mm"]))
        sure = figures["status"] == "converged" and found
        self.found += found
        self.found_and_sure += sure
        if figures["contacts"] >= laps.CONTACTS:
            self.full += 1
            self.full_found += found
            self.full_found_and_sure += sure
            self.lost_laps += [number] * (not sure)
        self.explain((law["expected"], law["counted"], law["slack"]) for law in figures["laws"])
        for row in figures["faults"]:
            if row["injected"]:
                self._add_fault(row)
        failed = [check for check in grade.checks if check.passed is False]
        self.failures += [f"lap {number}: {check.name}: {check.detail}" for check in failed]
        del self.failures[FAILURES_KEPT:]

    def explain(self, laws: Iterable[tuple[int, int, int]]) -> None:
        """Count what these laws (expected, counted, slack) of this daemon leave unexplained."""
        gaps = (abs(expected - counted) - slack for expected, counted, slack in laws)
        self.unexplained = self.unexplained_before + sum(max(gap, 0) for gap in gaps)

    def _add_fault(self, row: dict[str, Any]) -> None:
        kind, recovered_s = row["kind"], row["recovered_s"]
        self.faults[kind] += 1
        if row["flag"] is not None:
            late = row["detected_s"] is None or row["detected_s"] > row["within_s"]
            self.flags_missed[kind] += late
        if row["overlapped"]:
            return
        if recovered_s is not None:
            worst = max(self.worst_recovery_s.get(kind, 0.0), recovered_s)
            self.worst_recovery_s[kind] = round(worst, 3)
        if row["doubted"]:
            self.doubted[kind] += 1
        elif recovered_s is None:
            self.not_recovered[kind] += 1

    def left(self, base: Scenario, kinds: tuple[str, ...]) -> Iterator[tuple[int, Scenario, int]]:
        """The laps until the hours are over: number, scenario and seed of each."""
        while self.hours_done < self.hours:
            number = self.laps
            yield number, laps.lap(base, self.seed, number, kinds), self.seed + number

    def report(self, path: Path, say: Say, pid: int | str = "") -> None:
        """Write all that has been seen, with the memory of a process, and say it in short."""
        if pid:
            self.rss_mb.append((round(self.hours_done, 3), resident_mb(pid)))
        seen = {spec.name: getattr(self, spec.name) for spec in fields(self)}
        seen |= {"stanford": self.stanford.row()}
        seen |= {"growth_mb": self.growth_mb, "passed": self.passed}
        path.write_text(json.dumps(seen, indent=1) + "\n", encoding="utf-8")
        say(self.line())

    def line(self) -> str:
        """Progress in short."""
        rss = self.rss_mb[-1][1] if self.rss_mb else 0.0
        return (
            f"{self.hours_done:6.2f} of {self.hours:g} h, lap {self.laps}, "
            f"{self.faults.total()} faults, found and sure {self.found_and_sure}, "
            f"of {self.full} with all contacts {self.full_found_and_sure}, "
            f"misleading {self.misleading_after.total()}, unexplained {self.unexplained}, "
            f"worst recovery {max(self.worst_recovery_s.values(), default=0.0):.2f} s, "
            f"{rss:.0f} MB"
        )


def resumed(path: Path, base: Scenario, new: Soak) -> Soak:
    """The soak that a report holds, if it is like the `new` one and not over; else the new one.

    Raises:
        SetupError: there is a file that is no report, or one of an older kind.
    """
    new = replace(new, object=base.bundle, physics=base.physics, layout=layout_name(base.layout))
    if not path.is_file():
        return new
    try:
        data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        alike = all(data[name] == getattr(new, name) for name in ASKED)
    except OSError as error:
        raise SetupError(f"{path}: {error.strerror}") from None
    except (ValueError, TypeError, KeyError):
        raise SetupError(f"{path}: is no report of a soak; name another file") from None
    if not {spec.name for spec in fields(Soak)} <= data.keys():
        raise SetupError(f"{path}: is a report of an older kind; name another file")
    if not alike or data["hours_done"] >= new.hours:
        return new
    kept = {spec.name: data[spec.name] for spec in fields(Soak)}
    kept["stanford"] = Stanford.of_row(kept["stanford"])
    for name in ("faults", "misleading_after", "flags_missed", "doubted", "not_recovered"):
        kept[name] = Counter(kept[name])
    return Soak(**{**kept, "hours": new.hours, "unexplained_before": kept["unexplained"]})


def soak_fake(base: Scenario, soak: Soak, path: Path, say: Say) -> Soak:
    """Run the laps on the fake clock, as fast as they go."""
    run: FakeRun | None = None
    scans, units = soak.scans_sent, soak.units
    for number, scenario, seed in soak.left(base, () if soak.faultless else laps.KINDS):
        began = time.process_time()
        if run is None:
            run = FakeRun(scenario, seed, rate_hz=RATE_HZ, learns=soak.learns)
            soak.daemons += 1
        else:
            run.lap(scenario, seed)
        soak.add(number, run.graded(f"lap {number}"), run.line.t)
        soak.cpu_s += time.process_time() - began
        ledger = run.rig.ledger
        soak.scans_sent, soak.units = scans + ledger.scans_sent, units + ledger.fates.units
        if soak.laps % REPORT_EVERY == 0:
            soak.report(path, say, "self" if soak.laps > SETTLED_LAPS else "")
    soak.report(path, _silence)
    return soak


def lap_alone(base: Scenario, seed: int, number: int) -> Grade:
    """A lap of a soak on the fake clock, of the same skin and object, on a daemon of its own."""
    run = FakeRun(laps.lap(base, seed, 0), seed, rate_hz=RATE_HZ)
    if number:
        run.lap(laps.lap(base, seed, number), seed + number)
    return run.graded(f"lap {number}")


def soak_live(base: Scenario, soak: Soak, path: Path, say: Say) -> Soak:
    """Run the laps in real time, over the scenario's transport.

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
            scans, units = soak.scans_sent, soak.units
            for number, scenario, seed in soak.left(base, kinds):
                lap = run.lap(bench, f"lap {number}", scenario, seed)
                soak.add(number, lap, bench.rig.duration_s)
                soak.scans_sent, soak.units = scans + ledger.scans_sent, units + ledger.fates.units
                soak.report(path, say, run.processes.daemon.pid)
            soak.explain((law.expected, law.counted, law.slack) for law in run.settled(bench))
    soak.report(path, _silence)
    return soak


def resident_mb(pid: int | str) -> float:
    """Resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) / 1024.0


def _silence(_: str) -> None:
    """Nothing is printed."""
