"""`taxeld-hil soak`: random faults from a seed, for hours of scans, on one daemon.

Lap follows lap: the daemon keeps its counters and its memory, and with each lap the object stands
elsewhere and is looked for anew. A soak is a job; its result has a row a lap.
"""

import math
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median_high
from typing import Any

from taxeld_hil.experiment.measurement import RunRow, about, digest, row, title
from taxeld_hil.grade.grade import Grade
from taxeld_hil.jobs import Job
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.run.live import LiveRun
from taxeld_hil.scenario import laps
from taxeld_hil.scenario.scenario import Scenario

LIVE_KINDS = (*laps.KINDS, "subscriber_dead")
SETTLED_LAPS = 30  # on the fake clock memory is compared from here on: caches have filled
GROWTH_MAX_MB = 8.0
RATE_HZ = 40.0  # ticks on the fake clock, where none is late


def jobs(subjects: Iterable[Scenario], seed: int, hours: float, *, real: bool) -> list[Job]:
    """A soak of each subject; `real`: in real time, over the scenario's transport.

    Raises:
        SetupError: a subject's bundle or layout cannot be found or read.
    """
    return [
        Job(title("soak", each, seed), play, (each, seed, hours, real), code=digest(each))
        for each in subjects
    ]


def play(base: Scenario, seed: int, hours: float, real: bool) -> RunRow:
    """All laps, and how many frames, packets, scans and poses the daemon has not accounted for.

    Raises:
        SetupError: a process failed.
    """
    rows, held = (_live if real else _fake)(base, seed, hours)
    gaps = (abs(law["expected"] - law["counted"]) - law["slack"] for law in held)
    unexplained = sum(max(gap, 0) for gap in gaps)
    return {**about(base, seed), "real": real, "unexplained": unexplained, "laps": rows}


def _fake(
    base: Scenario, seed: int, hours: float
) -> tuple[list[RunRow], Sequence[Mapping[str, Any]]]:
    """Rows and the last lap's accounts, on the fake clock."""
    run = FakeRun(laps.lap(base, seed, 0), seed, rate_hz=RATE_HZ)
    rows = list[RunRow]()
    while not rows or _hours(rows) < hours:
        if number := len(rows):
            run.lap(laps.lap(base, seed, number), seed + number)
        grade = run.graded(f"lap {number}")
        rows.append(_lap(grade, run.line.t, "self"))
    return rows, grade.figures["laws"]


def _live(
    base: Scenario, seed: int, hours: float
) -> tuple[list[RunRow], Sequence[Mapping[str, Any]]]:
    """The same in real time."""
    rows = list[RunRow]()
    with tempfile.TemporaryDirectory(prefix="taxeld-") as temporary:
        place = Path(temporary)
        first = laps.lap(base, seed, 0, LIVE_KINDS)
        run = LiveRun("soak", first, seed, place / "session", "", lambda _: None)
        with run.opened(place) as bench:
            while not rows or _hours(rows) < hours:
                number = len(rows)
                lap = laps.lap(base, seed, number, LIVE_KINDS)
                grade = run.lap(bench, f"lap {number}", lap, seed + number)
                rows.append(_lap(grade, bench.rig.duration_s, run.processes.daemon.pid))
            held = run.settled(bench)
    return rows, [law._asdict() for law in held]


def _lap(grade: Grade, seconds: float, pid: int | str) -> RunRow:
    """The row of a lap that took so many seconds of scenario time, and a process's memory then."""
    return row(grade) | {"seconds": seconds, "rss_mb": round(resident_mb(pid), 1)}


def _hours(rows: Iterable[RunRow]) -> float:
    return math.fsum(each["seconds"] for each in rows) / 3600.0


def misled_after(lap: RunRow) -> Counter[str]:
    """The faults that explain what misled in a lap. The daemon remembers what a deceptive fault
    made it believe, so the last of these explains it; without one the last fault before."""
    found = Counter[str]()
    for at_s in lap["misleading_at_s"]:
        begun = [each["kind"] for each in lap["faults"] if each["at_s"] <= at_s]
        deceived = [kind for kind in begun if kind in laps.DECEPTIVE]
        found[(deceived or begun or ["none"])[-1]] += 1
    return found


def faults(run: RunRow) -> list[dict[str, Any]]:
    """Those that were injected."""
    return [each for lap in run["laps"] for each in lap["faults"] if each["injected"]]


def not_recovered(run: RunRow) -> Counter[str]:
    """Faults after which nothing was usable in time, though no other fault and no doubt about the
    object explains it."""
    return Counter(
        each["kind"]
        for each in faults(run)
        if each["recovered_s"] is None and not each["overlapped"] and not each["doubted"]
    )


def growth_mb(run: RunRow) -> float:
    """Growth of memory, from the median of the first third to the median of the last."""
    values = [lap["rss_mb"] for lap in run["laps"][0 if run["real"] else SETTLED_LAPS :]]
    third = max(len(values) // 3, 1)
    return median_high(values[-third:]) - median_high(values[:third]) if values else 0.0


def passed(run: RunRow) -> bool:
    """Nothing unaccounted for, all recovered, memory flat; and nothing misleading but after
    faults that look like a touch elsewhere."""
    misled = sum(map(misled_after, run["laps"]), Counter[str]())
    lost = run["unexplained"] or not_recovered(run) or growth_mb(run) >= GROWTH_MAX_MB
    return not lost and misled.keys() <= {*laps.DECEPTIVE}


def described(run: RunRow) -> str:
    """A soak in short; laps in which the daemon felt as many contacts as there were are *full*."""
    rows = run["laps"]
    sure = [lap["found"] and lap["status"] == "converged" for lap in rows]
    full = [one for one, lap in zip(sure, rows, strict=True) if lap["contacts"] >= laps.CONTACTS]
    misled = sum(map(misled_after, rows), Counter[str]())
    recovered_s = [each["recovered_s"] or 0.0 for each in faults(run) if not each["overlapped"]]
    parts = [
        "passed" if passed(run) else "failed",
        f"{_hours(rows):.2f} h",
        f"{len(rows)} laps, {sum(sure)} found and sure, {sum(full)} of {len(full)} full ones",
        f"{len(faults(run))} faults, worst recovery {max(recovered_s, default=0.0):.2f} s",
        f"unexplained {run['unexplained']}",
        f"memory {growth_mb(run):+.1f} MB",
    ]
    for what, counts in (("misleading after", misled), ("not recovered from", not_recovered(run))):
        parts += [f"{what} {kind} {count}" for kind, count in counts.items()]
    return "; ".join(parts)


def resident_mb(pid: int | str) -> float:
    """Resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) / 1024.0
