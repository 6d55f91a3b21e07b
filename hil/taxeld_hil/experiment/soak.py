"""`taxeld-hil soak`: random faults from a seed, for hours of scans.

On the fake clock a lap of a minute is a run, with a daemon of its own. In real time one daemon is
touched for so long, and its memory may not grow.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

from taxeld_hil.experiment import runs
from taxeld_hil.experiment.runs import RunRow
from taxeld_hil.jobs import Job
from taxeld_hil.scenario import laps
from taxeld_hil.scenario.scenario import Scenario

GROWTH_MAX_MB = 8.0
LIVE_MAX = 120  # minutes, as a scenario has a thousand contacts at most


def jobs(base: Scenario, seed: int, minutes: int, *, real: bool) -> list[Job]:
    """The laps; in real time it is one.

    Raises:
        SetupError: the bundle or the layout cannot be found or read.
    """
    if real:
        return [runs.of("soak", laps.lap(base, seed, 0, minutes), seed, real=True)]
    return [
        runs.of(f"lap {number}", laps.lap(base, seed, number), seed + number)
        for number in range(minutes)
    ]


def misled_after(rows: Sequence[RunRow]) -> Counter[str]:
    """The faults that explain what misled. The daemon remembers what a deceptive fault made it
    believe, so the last of these in a lap explains it; without one the last fault before."""
    found = Counter[str]()
    for lap in rows:
        for at_s in lap["misleading_at_s"]:
            begun = [each["kind"] for each in lap["faults"] if each["at_s"] <= at_s]
            deceived = [kind for kind in begun if kind in laps.DECEPTIVE]
            found[(deceived or begun or ["none"])[-1]] += 1
    return found


def faults(rows: Sequence[RunRow]) -> list[dict[str, Any]]:
    """Those that were injected."""
    return [each for lap in rows for each in lap["faults"] if each["injected"]]


def not_recovered(rows: Sequence[RunRow]) -> Counter[str]:
    """Faults after which nothing was usable in time, though no other fault and no doubt about the
    object explains it."""
    return Counter(
        each["kind"]
        for each in faults(rows)
        if each["recovered_s"] is None and not each["overlapped"] and not each["doubted"]
    )


def uncounted(rows: Sequence[RunRow]) -> list[str]:
    """The accounts that do not balance."""
    return [name for lap in rows for name in lap["failed"] if name.startswith("accounts")]


def passed(rows: Sequence[RunRow]) -> bool:
    """Nothing unaccounted for, all recovered, memory flat; and nothing misleading but after
    faults that look like a touch elsewhere."""
    grew = any(lap["growth_mb"] >= GROWTH_MAX_MB for lap in rows)
    lost = uncounted(rows) or not_recovered(rows) or grew
    return not lost and misled_after(rows).keys() <= {*laps.DECEPTIVE}


def described(rows: Sequence[RunRow]) -> str:
    """A soak in short; laps in which the daemon felt as many contacts as there were are *full*."""
    full = [runs.is_sure(lap) for lap in rows if lap["contacts"] >= lap["touches"]]
    recovered_s = [each["recovered_s"] or 0.0 for each in faults(rows) if not each["overlapped"]]
    parts = [
        "passed" if passed(rows) else "failed",
        f"{math.fsum(lap['seconds'] for lap in rows) / 3600.0:.2f} h",
        f"{len(rows)} laps, {sum(map(runs.is_sure, rows))} found and sure, "
        f"{sum(full)} of {len(full)} full ones",
        f"{len(faults(rows))} faults, worst recovery {max(recovered_s, default=0.0):.2f} s",
        f"{len(uncounted(rows))} accounts do not balance",
        f"memory {max(lap['growth_mb'] for lap in rows):+.1f} MB",
        *(f"misleading after {kind} {count}" for kind, count in misled_after(rows).items()),
        *(f"not recovered from {kind} {count}" for kind, count in not_recovered(rows).items()),
    ]
    return "; ".join(parts)
