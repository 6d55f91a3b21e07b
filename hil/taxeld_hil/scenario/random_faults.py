"""Minutes of presses and of faults that a seed draws, in place of a scenario's own."""

from dataclasses import replace
from functools import cache

import numpy as np

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld_hil.scenario.scenario import SKIN_KINDS, Expect, Fault, Scenario

MOST = 120  # minutes, as a scenario has a thousand contacts at most
CONTACTS = 8  # a minute
HOLDS_S = (0.3, 0.3, 0.3, 2.0, 6.0)  # one of these for all presses
FIRST_S, LAST_S = 3.0, 40.0  # of a minute: between these a fault begins
PAUSE_S = 6.0  # mean time to the next fault
FAULTS_MEAN = 1.5  # a minute
FOR_S = (0.2, 6.0)
SHOWN_S = 3.0  # long enough to hit something, and for the daemon to show it
STUCK_S = (12.5, 15.0)  # long enough for the daemon to find a stuck taxel

FRAMES = ("dropped", "duplicated", "reordered", "corrupted", "late", "flooded")
DEVICE = ("reboot", "unplugged")
# not drawn: a fault that looks like a touch elsewhere misleads, and has scenarios of its own
DECEPTIVE = ("baseline_jump", "pose_late", "pose_jumping")
KINDS = (*FRAMES, *(kind for kind in SKIN_KINDS if kind not in DECEPTIVE), *DEVICE, "pose_silent")


def drawn(base: Scenario, seed: int, minutes: int) -> Scenario:
    """The scenario of so many minutes, or more where presses are long; a fault begins when those
    before it are over and recovered from.

    Raises:
        SetupError: `minutes` is out of range, or the layout cannot be read.
    """
    if not 1 <= minutes <= MOST:
        raise SetupError(f"--random: must be 1..{MOST} minutes")
    rng = np.random.default_rng(seed)
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
