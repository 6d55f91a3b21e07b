"""`taxeld-hil soak`: random faults from a seed, for hours of scans.

On the fake clock a lap of a minute is a run, with a daemon of its own; it follows from the soak's
seed and its number alone. In real time one daemon is touched for so long, and its memory may not
grow.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from taxeld.layout import read as layouts
from taxeld_hil.experiment import runs
from taxeld_hil.experiment.runs import RunRow
from taxeld_hil.jobs import Job
from taxeld_hil.scenario.scenario import SKIN_KINDS, Expect, Fault, Scenario

GROWTH_MAX_MB = 8.0
LIVE_MAX = 120  # minutes, as a scenario has a thousand contacts at most

CONTACTS = 8  # a minute
HOLDS_S = (0.3, 0.3, 0.3, 2.0, 6.0)  # one of these for each lap's presses
FIRST_S, LAST_S = 3.0, 40.0  # of a minute: between these a fault begins
PAUSE_S = 6.0  # mean time to the next fault
FAULTS_MEAN = 1.5  # a minute
FOR_S = (0.2, 6.0)
SHOWN_S = 3.0  # long enough to hit something, and for the daemon to show it
STUCK_S = (12.5, 15.0)  # long enough for the daemon to find a stuck taxel

FRAMES = ("dropped", "duplicated", "reordered", "corrupted", "late", "flooded")
DEVICE = ("reboot", "unplugged")
ROBOT = ("pose_silent", "pose_late", "pose_jumping")
KINDS = FRAMES + SKIN_KINDS + DEVICE + ROBOT
DECEPTIVE = ("baseline_jump", "pose_late", "pose_jumping")  # look like a touch elsewhere


def jobs(base: Scenario, seed: int, minutes: int, *, real: bool) -> list[Job]:
    """The laps; in real time it is one.

    Raises:
        SetupError: the bundle or the layout cannot be found or read.
    """
    if real:
        return [runs.of("soak", lap(base, seed, 0, minutes), seed, real=True)]
    return [
        runs.of(f"lap {number}", lap(base, seed, number), seed + number)
        for number in range(minutes)
    ]


def misled_after(rows: Sequence[RunRow]) -> Counter[str]:
    """The faults that explain what misled. The daemon remembers what a deceptive fault made it
    believe, so the last of these in a lap explains it; without one the last fault before."""
    found = Counter[str]()
    for row in rows:
        for at_s in row["misleading_at_s"]:
            begun = [each["kind"] for each in row["faults"] if each["at_s"] <= at_s]
            deceived = [kind for kind in begun if kind in DECEPTIVE]
            found[(deceived or begun or ["none"])[-1]] += 1
    return found


def faults(rows: Sequence[RunRow]) -> list[dict[str, Any]]:
    """Those that were injected."""
    return [each for row in rows for each in row["faults"] if each["injected"]]


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
    return [name for row in rows for name in row["failed"] if name.startswith("accounts")]


def passed(rows: Sequence[RunRow]) -> bool:
    """Nothing unaccounted for, all recovered, memory flat; and nothing misleading but after
    faults that look like a touch elsewhere."""
    grew = any(row["growth_mb"] >= GROWTH_MAX_MB for row in rows)
    lost = uncounted(rows) or not_recovered(rows) or grew
    return not lost and misled_after(rows).keys() <= {*DECEPTIVE}


def described(rows: Sequence[RunRow]) -> str:
    """A soak in short; laps in which the daemon felt as many contacts as there were are *full*."""
    full = [runs.is_sure(row) for row in rows if row["contacts"] >= row["touches"]]
    recovered_s = [each["recovered_s"] or 0.0 for each in faults(rows) if not each["overlapped"]]
    parts = [
        "passed" if passed(rows) else "failed",
        f"{math.fsum(row['seconds'] for row in rows) / 3600.0:.2f} h",
        f"{len(rows)} laps, {sum(map(runs.is_sure, rows))} found and sure, "
        f"{sum(full)} of {len(full)} full ones",
        f"{len(faults(rows))} faults, worst recovery {max(recovered_s, default=0.0):.2f} s",
        f"{len(uncounted(rows))} accounts do not balance",
        f"memory {max(row['growth_mb'] for row in rows):+.1f} MB",
        *(f"misleading after {kind} {count}" for kind, count in misled_after(rows).items()),
        *(f"not recovered from {kind} {count}" for kind, count in not_recovered(rows).items()),
    ]
    return "; ".join(parts)


def lap(base: Scenario, seed: int, number: int, minutes: int = 1) -> Scenario:
    """The scenario of a lap of so many minutes, or more where presses are long; a fault begins when
    those before it are over and recovered from."""
    rng = np.random.default_rng([seed, number])
    modules, taxels = _sizes(base.skin_layout)
    hold_s, contacts = float(rng.choice(HOLDS_S)), CONTACTS * minutes
    faults, at_s = list[Fault](), 0.0
    for begin_s in range(0, 60 * minutes, 60):
        at_s = max(at_s, begin_s + FIRST_S)
        for _ in range(rng.poisson(FAULTS_MEAN)):
            at_s += float(rng.exponential(PAUSE_S))
            if at_s > begin_s + LAST_S:
                break
            faults.append(_fault(rng, str(rng.choice(KINDS)), round(at_s, 2), modules, taxels))
            at_s = faults[-1].end_s + base.expect.recovery_s + 1.0
    return replace(
        base,
        contacts=contacts,
        hold_s=hold_s,
        rest_s=max(60.0 * minutes - contacts * (3.0 + hold_s), 1.0),
        expect=Expect(found=False),
        fault=tuple(faults),
    )


@cache
def _sizes(layout: str) -> tuple[int, int]:
    uid = layouts.load(layout).uid
    return len(np.unique(uid >> 4)), len(uid)


def _fault(rng: np.random.Generator, kind: str, at_s: float, modules: int, taxels: int) -> Fault:
    shortest, longest = STUCK_S if kind == "taxel_stuck" else FOR_S
    if kind in (*FRAMES, *SKIN_KINDS):
        shortest = max(shortest, SHOWN_S)
    named = kind in ("taxel_stuck", "saturated")
    return Fault(
        kind=kind,
        at_s=at_s,
        for_s=round(float(rng.uniform(shortest, longest)), 2),
        share=round(float(rng.uniform(0.02, 0.3)), 3),
        delay_s=round(float(rng.uniform(0.02, 0.6)), 3),
        per_s=float(rng.integers(100, 4000)),
        module=int(rng.integers(modules)),
        taxels=tuple(sorted(rng.choice(taxels, 2, replace=False).tolist())) if named else (),
        counts=float(rng.choice([-3000.0, 3000.0])),
        offset_m=float(rng.uniform(1.5, 5.0)),
    )
