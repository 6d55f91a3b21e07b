"""Acceptance: presses by hand on one module after the other, and which module answered to each."""

import math
from collections.abc import Sequence

import numpy as np

from taxeld.arrays import Bools, Floats, Index
from taxeld.layout.layout import Layout
from taxeld_hil.acceptance.values import CheckResult, Finding, Press, Received, listed

PRESS_SCANS = 2  # in a row: a single one may be a disturbance
RELEASED_S = 0.3
WEAK = 0.1  # of full scale; a taxel's strongest on a real skin is 0.43 of it (median)
STRONG = 1.5  # of full scale: presses that read the same, as activations end at 1


class PressDetector:
    """Follows presses: one begins when a skin that was free is touched, and ends when it is free
    again. The skin is taken to be free at the start, as its idle level was just measured."""

    def __init__(self, level: Floats, threshold: Floats, usable: Bools) -> None:
        """Idle levels and thresholds [counts] of M taxels; those not `usable` are passed over."""
        self._level, self._threshold, self._usable = level, threshold, usable
        self._over: Floats = np.zeros(len(level))
        self._free = True
        self.begin()

    def begin(self) -> None:
        """Wait for the next press."""
        self.peak: Floats = np.zeros(len(self._level))
        self.pressed = self.done = False
        self._scans_over, self._over_s = 0, -math.inf

    def on_counts(self, t: float, taxels: Index, counts: Floats) -> None:
        """Counts of some taxels, nan where lost, as a scan brought them at time t."""
        over = np.where(self._usable[taxels], counts - self._level[taxels], 0.0)
        self._over[taxels] = np.where(np.isfinite(over), over, self._over[taxels])
        if not (self._over > self._threshold).any():
            self._scans_over = 0
            self._free = self._free or t - self._over_s > RELEASED_S
            self.done = self.pressed and self._free
            return
        self._over_s = t
        self._scans_over += 1
        if self._free and self._scans_over >= PRESS_SCANS:
            self.pressed, self._free = True, False
        if self.pressed:
            self.peak = np.maximum(self.peak, self._over)

    def answer(self, module: Index) -> int | None:
        """Which module was pressed most, by each taxel's module (M,); None: there was no press."""
        if not self.pressed:
            return None
        pressed = np.where(self.peak > self._threshold, self.peak, 0.0)
        return int(np.bincount(module, pressed).argmax())


def place(layout: Layout, module: int) -> str:
    """Where the operator finds a module, as the layout has it."""
    own = np.unique(layout.uid >> 4, return_inverse=True)[1] == module
    x, y, z = layout.position_m[own].mean(axis=0)
    if math.isinf(layout.radius_m):
        return f"x {1e3 * x:.0f} mm, y {1e3 * y:.0f} mm"
    return f"{math.degrees(math.atan2(y, x)) % 360:.0f}° about the axis, z {1e3 * z:.0f} mm"


def press(received: Received) -> CheckResult:
    """Each module answers where the layout has it, as strongly as the daemon expects."""
    name, presses = "press", received.presses
    if presses is None:
        return CheckResult(name, "not asked for (--press)", checked=False)
    if not presses:
        return CheckResult(name, "no module that can be pressed", checked=False)
    serials, notes = received.serials, []
    findings = _unanswered(received, presses) + _weak(received, presses)
    strongest = max(float(p.peak.max()) for p in presses)
    full_scale = received.full_scale_counts
    if strongest > STRONG * full_scale:
        notes.append(
            f"the strongest press is {strongest / full_scale:.1f} times full scale; where such "
            f"presses are to be told apart, raise full_scale_counts towards {strongest:.0f}"
        )
    right = sum(p.asked == p.answered for p in presses)
    return CheckResult(
        name,
        f"{right} of {len(presses)} modules answered where they are; strongest {strongest:.0f} "
        f"counts, {100 * strongest / full_scale:.0f} % of full scale",
        findings,
        notes,
        {
            str(serials[p.asked]): {
                "answered": None if p.answered is None else serials[p.answered],
                "peak_counts": float(p.peak.max()),
            }
            for p in presses
        },
    )


def _unanswered(received: Received, presses: Sequence[Press]) -> list[Finding]:
    """Modules that did not answer, or for which another one did."""
    serials, places = received.serials, received.places
    answers = {p.asked: p.answered for p in presses}
    findings = []
    for one in presses:
        sui = serials[one.asked]
        if one.answered is None:
            findings.append(
                Finding(
                    f"module {sui} ({places.get(sui, 'no hub')})",
                    "nothing was felt when it was to be pressed",
                    "press harder, on the module that was named; if nothing is felt again, check "
                    "its cable, and that its serial number is the one the layout has there",
                )
            )
        elif one.answered != one.asked:
            findings += _elsewhere(one.asked, one.answered, answers, serials)
    return findings


def _elsewhere(
    asked: int, answered: int, answers: dict[int, int | None], serials: Sequence[int]
) -> list[Finding]:
    """What is wrong where another module answered; a swapped pair is one finding, not two."""
    here, there = serials[asked], serials[answered]
    if answers.get(answered) == asked:
        if asked > answered:
            return []
        return [
            Finding(
                f"modules {here} and {there}",
                "answer for each other: they are swapped",
                "exchange the two on the link, or their serial numbers in the layout file",
            )
        ]
    return [
        Finding(
            f"module {here}",
            f"module {there} answered when it was pressed",
            "press once more to be sure; then correct the serial numbers in the layout file",
        )
    ]


def _weak(received: Received, presses: Sequence[Press]) -> list[Finding]:
    serials, limit = received.serials, WEAK * received.full_scale_counts
    weak = [p for p in presses if p.answered is not None and p.peak.max() < limit]
    if not weak:
        return []
    names = listed([str(serials[p.asked]) for p in weak])
    most = max(float(p.peak.max()) for p in weak)
    return [
        Finding(
            f"module{'s' * (len(weak) > 1)} {names}",
            f"felt {most:.0f} counts at most, under {100 * WEAK:.0f} % of full scale",
            "press harder and run once more; if it stays so, set skin.full_scale_counts of the "
            "daemon to what a firm press reads, or see whether the dielectric has hardened",
        )
    ]
