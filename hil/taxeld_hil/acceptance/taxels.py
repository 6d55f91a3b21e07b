"""Acceptance: noise, taxels that fail, and the modules' temperatures, of an untouched skin."""

from collections.abc import Callable

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.config.tables import SkinConfig
from taxeld.model.activation import FLOOR
from taxeld.skin.capture import NOISE_MAX
from taxeld.skin.frozen import NOISE_TELLS
from taxeld.skin.skin import INVALID_FROM
from taxeld.skin.temperature import STEP
from taxeld_hil.acceptance.readings import IdleReadings
from taxeld_hil.acceptance.values import CheckResult, Finding, Received, listed, name_of

STILL_SCANS = 50  # two readings with a noise of a count agree in 0.28 of cases: 1e-27 for fifty
INVALID = 0.01  # of the scans
STANDS_OUT = 10.0  # times the skin's median noise; 23..59 counts is what 80 % of a skin lie in
SD_OF_MEDIAN = np.sqrt(np.pi / 2.0)  # √n times: of n normal readings
THRESHOLD_SIGMAS = SkinConfig().threshold_sigmas

_TAXEL = (
    "check that the module's dielectric is on and dry and that its surface is not cut; if only "
    "this taxel fails, mark it as cut in the layout: the daemon works without it"
)
_MODULE = "the whole module fails: check its cable and supply, then replace the module"
_GROUND = (
    "run once more with the skin untouched; then check the ground between skin, hub and robot, "
    "and keep motor cables away; a single taxel can be marked as cut in the layout"
)


def thresholds(noise: Floats, full_scale_counts: float) -> Floats:
    """Counts over the idle level from which the daemon takes a reading for a touch."""
    return np.maximum(THRESHOLD_SIGMAS * noise, FLOOR * full_scale_counts)


def failing(got: IdleReadings) -> dict[str, Bools]:
    """Taxels (M,) that cannot be used, by their fault; each has one at most."""
    saturated = got.saturated > INVALID
    dead = (got.zero > INVALID) & ~saturated
    fine = got.present & ~dead & ~saturated
    can_tell = bool(fine.any()) and float(np.median(got.noise[fine])) >= NOISE_TELLS
    stuck = fine & got.still & (got.scans >= STILL_SCANS) & can_tell
    return {"dead": dead, "stuck": stuck, "saturated": saturated}


def noisy(got: IdleReadings, full_scale_counts: float) -> Bools:
    """Taxels (M,) whose noise the daemon would not accept, or stands out of the skin's."""
    usable = got.present & ~np.any([*failing(got).values()], axis=0)
    if not usable.any():
        return np.asarray(usable)
    # below this the daemon's threshold is the same for all, and noise does not matter
    least = FLOOR * full_scale_counts / THRESHOLD_SIGMAS
    limit = max(STANDS_OUT * float(np.median(got.noise[usable])), least)
    return np.asarray(usable & (got.noise > min(limit, NOISE_MAX * full_scale_counts)))


def noise(received: Received, got: IdleReadings) -> CheckResult:
    """How much the readings of the untouched skin vary."""
    usable = got.present & ~np.any([*failing(got).values()], axis=0)
    if not usable.any():
        return CheckResult("noise", "no taxel that reads", checked=False)
    full_scale = received.full_scale_counts
    bad = noisy(got, full_scale)
    low, middle, high = np.percentile(got.noise[usable], (10, 50, 90))
    findings = _by_module(
        received,
        bad,
        lambda i: (
            f"noise {got.noise[i]:.0f} counts, {100 * got.noise[i] / full_scale:.1f} % of "
            f"full scale, where the skin's is {middle:.1f}"
        ),
        _GROUND,
    )
    notes = []
    if middle < NOISE_TELLS:
        notes.append(
            "the noise is less than a count, so a taxel that stands still cannot be told from a "
            "quiet one: use --press"
        )
    return CheckResult(
        "noise",
        f"{middle:.1f} counts (10..90 %: {low:.1f}..{high:.1f}), "
        f"{100 * middle / full_scale:.2f} % of full scale; {int(bad.sum())} taxels too noisy",
        findings,
        notes,
        {"median": float(middle), "p10": float(low), "p90": float(high)},
    )


def taxels(received: Received, got: IdleReadings) -> CheckResult:
    """Taxels that are dead, stuck or saturated."""
    name = "taxels"
    if not got.present.any():
        return CheckResult(name, "no taxel of the layout was heard", checked=False)
    groups = failing(got)
    details = {
        "dead": lambda i: f"reads 0 in {100 * got.zero[i]:.0f} % of the scans",
        "stuck": lambda i: f"reads {got.level[i]:.0f} without a count of change",
        "saturated": lambda i: (
            f"reads {INVALID_FROM} or more in {100 * got.saturated[i]:.0f} % of the scans"
        ),
    }
    findings = [
        finding
        for kind, mask in groups.items()
        for finding in _by_module(received, mask, details[kind], _TAXEL, kind)
    ]
    counted = ", ".join(f"{int(mask.sum())} {kind}" for kind, mask in groups.items())
    idle = got.level[got.present]
    return CheckResult(
        name,
        f"{int(got.present.sum())} of {len(received.layout)} heard: {counted}; "
        f"idle levels {idle.min():.0f}..{idle.max():.0f} counts",
        findings,
        figures={kind: np.flatnonzero(mask).tolist() for kind, mask in groups.items()},
    )


def temperature(received: Received, got: IdleReadings) -> CheckResult:
    """The modules' T0: a valid reading that moves as slowly as a temperature."""
    heard = np.isfinite(got.t0_level)
    if not heard.any():
        return CheckResult("temperature", "no T0 was heard", checked=False)
    # two medians of n readings differ by 1.25 √(2 / n) of their noise
    spread = SD_OF_MEDIAN * np.sqrt(2.0 * received.period_ms / 1e3) * got.t0_noise
    limit = np.maximum(STEP * received.full_scale_counts, THRESHOLD_SIGMAS * spread)
    places = received.places
    findings = []
    for k in np.flatnonzero(heard):
        sui = received.serials[k]
        where = f"T0 of module {sui} ({places[sui]})"
        if got.t0_invalid[k] > INVALID:
            share = 100 * got.t0_invalid[k]
            findings.append(
                Finding(
                    where,
                    f"0, or {INVALID_FROM} and more, in {share:.0f} % of the scans",
                    "this module's drift will not be compensated; replace the module if it matters",
                )
            )
        elif got.t0_step[k] > limit[k]:
            findings.append(
                Finding(
                    where,
                    f"jumped by {got.t0_step[k]:.0f} counts within a second; a temperature moves "
                    f"less than {limit[k]:.0f}",
                    "run once more with the skin untouched; then check the module's supply",
                )
            )
    level = got.t0_level[heard]
    return CheckResult(
        "temperature",
        f"T0 of {int(heard.sum())} modules: {level.min():.0f}..{level.max():.0f} counts, "
        f"at most {got.t0_step[heard].max():.0f} counts in a second",
        findings,
    )


def _by_module(
    received: Received, bad: Bools, what: Callable[[int], str], cure: str, kind: str = ""
) -> list[Finding]:
    """A finding for each module: one that fails as a whole is one fault, not ten."""
    uid, places = received.layout.uid, received.places
    serial = uid >> 4
    findings = []
    for sui in np.unique(serial[bad]).tolist():
        own, failed = np.flatnonzero(serial == sui), np.flatnonzero(bad & (serial == sui))
        failed = failed[np.argsort(uid[failed])]
        names = listed([name_of(int(uid[i])) for i in failed])
        whole = len(failed) == len(own) > 1
        where = f"{names} of module {sui} ({places.get(sui, 'no hub')})"
        first = what(int(failed[0]))
        what_fails = f"{kind}: {first}" if kind else first
        if len(failed) > 1:
            what_fails += f" ({name_of(int(uid[failed[0]]))}; the others alike)"
        findings.append(Finding(where, what_fails, _MODULE if whole else cure))
    return findings
