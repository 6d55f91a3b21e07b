"""`taxeld-hil soak`: random faults from a seed, for hours of scans, on one daemon.

Lap follows lap: the daemon keeps its counters and its memory, and with each lap the object stands
elsewhere and is looked for anew. A soak is a job; each lap leaves a session, whose grade is a row.
"""

import math
from collections import Counter
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from statistics import median_high
from typing import Any

from taxeld_hil.experiment.measurement import RunRow, about, digest, row, title
from taxeld_hil.jobs import Job
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.run.live import SimulatedRun
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
    kinds, rows = LIVE_KINDS if real else laps.KINDS, list[RunRow]()
    first = laps.lap(base, seed, 0, kinds)
    with ExitStack() as stack:
        run: FakeRun | SimulatedRun
        if real:
            run = stack.enter_context(SimulatedRun(first, seed))
        else:
            run = FakeRun(first, seed, rate_hz=RATE_HZ)
        while not rows or _hours(rows) < hours:
            if number := len(rows):
                run.lap(laps.lap(base, seed, number, kinds), seed + number)
            graded = run.graded(f"lap {number}")
            pid = run.daemon.pid if isinstance(run, SimulatedRun) else "self"
            memory = {"seconds": graded.run.end_s, "rss_mb": round(resident_mb(pid), 1)}
            rows.append(row(graded) | memory)
    gaps = (abs(law["expected"] - law["counted"]) - law["slack"] for law in graded.figures["laws"])
    unexplained = sum(max(gap, 0) for gap in gaps)
    return {**about(base, seed), "real": real, "unexplained": unexplained, "laps": rows}


def _hours(rows: Iterable[RunRow]) -> float:
    return math.fsum(each["seconds"] for each in rows) / 3600.0


def misled_after(run: RunRow) -> Counter[str]:
    """The faults that explain what misled. The daemon remembers what a deceptive fault made it
    believe, so the last of these in a lap explains it; without one the last fault before."""
    found = Counter[str]()
    for lap in run["laps"]:
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
    lost = run["unexplained"] or not_recovered(run) or growth_mb(run) >= GROWTH_MAX_MB
    return not lost and misled_after(run).keys() <= {*laps.DECEPTIVE}


def described(run: RunRow) -> str:
    """A soak in short; laps in which the daemon felt as many contacts as there were are *full*."""
    rows = run["laps"]
    sure = [lap["found"] and lap["status"] == "converged" for lap in rows]
    full = [one for one, lap in zip(sure, rows, strict=True) if lap["contacts"] >= laps.CONTACTS]
    recovered_s = [each["recovered_s"] or 0.0 for each in faults(run) if not each["overlapped"]]
    parts = [
        "passed" if passed(run) else "failed",
        f"{_hours(rows):.2f} h",
        f"{len(rows)} laps, {sum(sure)} found and sure, {sum(full)} of {len(full)} full ones",
        f"{len(faults(run))} faults, worst recovery {max(recovered_s, default=0.0):.2f} s",
        f"unexplained {run['unexplained']}",
        f"memory {growth_mb(run):+.1f} MB",
        *(f"misleading after {kind} {count}" for kind, count in misled_after(run).items()),
        *(f"not recovered from {kind} {count}" for kind, count in not_recovered(run).items()),
    ]
    return "; ".join(parts)


def resident_mb(pid: int | str) -> float:
    """Resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) / 1024.0
