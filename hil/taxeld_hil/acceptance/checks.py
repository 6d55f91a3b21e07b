"""The acceptance checks: faults of a skin, and their cures.

A check is a function of what was received. `CHECKS` lists them in the order in which the report has
them.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.skin.channels import TEMPERATURE
from taxeld.skin.rest import NOISE_TELLS
from taxeld.skin.skin import INVALID_FROM
from taxeld.source.bus_faults import NORMAL, BusFault
from taxeld_hil.acceptance import cures
from taxeld_hil.acceptance.idle import INVALID
from taxeld_hil.acceptance.received import DAMAGES, Received
from taxeld_protocol.array import Group
from taxeld_protocol.decoder import GAP_SHARE
from taxeld_protocol.modules import NAMES, Module, wired

RATE_OFF = 0.1  # share of the period; a hub's clock is far better
JITTER_OFF = 1.0 - GAP_SHARE  # share of the period: an earlier scan may join the last one
MISSED = 0.01  # share of the scans, without a damaged packet to explain them
SCANS_MIN = 10  # scans that tell the rate of a hub
DAMAGED = 0.001  # share of the packets; CAN repeats damaged frames, so none should be
WEAK = 0.1  # full scales; a taxel's strongest on a real skin is 0.43 (median)
STRONG = 1.5  # full scales: activations end at 1, so stronger presses read the same
NAMES_MAX = 12  # names in one line


class Finding(NamedTuple):
    """One thing that is wrong."""

    where: str
    what: str
    cure: str


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The result of one check; `figures` are for machines, and go to the JSON alone."""

    summary: str
    findings: Sequence[Finding] = ()
    notes: Sequence[str] = ()  # worth knowing, and no fault
    figures: Mapping[str, object] = field(default_factory=dict)
    checked: bool = True  # False: its input was not received, or not asked for

    @property
    def verdict(self) -> str:
        if self.findings:
            return "failed"
        return "passed" if self.checked else "not checked"


def discovery(got: Received) -> CheckResult:
    """The hub answers the daemon's own bring-up, declares all its modules, and sends scans."""
    findings, parts = [] if got.scans else [*_bus(got.bring_up)], []
    if not got.tables and not findings:
        heard = _counted(got.bring_up, *cures.SILENCE) or "nothing at all was heard"
        cure = next((c for name, c in cures.SILENCE.items() if got.bring_up[name]), cures.POWER)
        findings.append(Finding("the bus", f"no hub declared its modules; {heard}", cure))
    for hub, table in got.tables.items():
        connected = [module for module in table if module.channels]
        unknown = [i for i, module in enumerate(table) if module.channels and module.sui is None]
        if unknown or not connected:
            what = "declares no module with a channel"
            if unknown:
                what = f"no details of the modules at positions {_listed(unknown)}"
            findings.append(Finding(f"hub {hub}", what, cures.SPI))
        elif not any(scan.ihb == hub for scan in got.scans) and not any(m.fault for m in table):
            what = "answers, but sent no scan after auto sync was switched on"
            findings.append(Finding(f"hub {hub}", what, cures.FIRMWARE))
        channels = sum(module.channels for module in connected)
        parts.append(f"hub {hub}: {len(connected)} modules, {channels} channels")
    notes = [f"hub {hub}: {versions}" for hub, versions in got.firmware.items()]
    return CheckResult("; ".join(parts) or "no hub answered", findings, notes)


def modules(got: Received) -> CheckResult:
    """The modules that answered are those of the layout, with the layout's taxels and T0."""
    connected = [m for table in got.tables.values() for m in table if m.channels]
    found = {m.sui: m for m in connected if m.sui is not None}
    if not found:
        return CheckResult("no module is known", checked=False)
    layout = {m.sui: m for m in wired(got.layout.uid.tolist()) if m.sui is not None}
    times = Counter(m.sui for m in connected)
    missing, unexpected = sorted(layout.keys() - found), sorted(found.keys() - layout)
    findings, notes = [], []
    if missing:
        taxels = sum(layout[sui].channels - 1 for sui in missing)  # without T0
        what = f"did not answer; {taxels} taxels of the layout are not read"
        where = f"module{'s' * (len(missing) > 1)} {_listed(missing)}"
        findings.append(Finding(where, what, f"{cures.SPI}; else {cures.LAYOUT}"))
    if unexpected:
        where = _listed([got.module(sui) for sui in unexpected])
        findings.append(Finding(where, "answered, but not in the layout", cures.LAYOUT))
    for sui, module in found.items():
        if times[sui] > 1:
            what = f"{times[sui]} modules answer to this serial number"
            findings.append(Finding(got.module(sui), what, "give one of them its own number"))
        if module.fault:
            what, _, cure = module.fault.partition("; ")
            findings.append(Finding(got.module(sui), f"{what}: its hub is refused", cure))
    for sui in sorted(layout.keys() & found):
        where = got.module(sui)
        findings += [Finding(where, what, cures.MASK) for what in _mask(layout[sui], found[sui])]
        extra = _names(found[sui].mask & ~layout[sui].mask)
        if extra:
            notes.append(f"{where}: {extra} are not in the layout; the daemon passes them over")
    there = len(layout) - len(missing)
    summary = f"{there} of the layout's {len(layout)} answered, {len(unexpected)} unexpected"
    return CheckResult(summary, findings, notes, {"missing": missing, "unexpected": unexpected})


def _mask(layout: Module, found: Module) -> Iterator[str]:
    mask = f"its mask {found.mask:#05x}"
    if absent := _names(layout.mask & ~found.mask & ~(1 << TEMPERATURE)):
        yield f"{mask} leaves out {absent}, which the layout has"
    if not (found.mask >> TEMPERATURE & 1 or isinstance(found, Group)):  # of an array: it has none
        yield f"{mask} has no T0: its drift cannot be told from a touch"


def _names(mask: int) -> str:
    return ", ".join(f"T{bit}" for bit in range(NAMES) if mask >> bit & 1)


def rate(got: Received) -> CheckResult:
    """Scans come as often as they were asked for, evenly, and none is missing."""
    if not got.scans:
        return CheckResult("no scan came", checked=False)
    explained: float = got.damaged + got.link["orphan"]
    if got.link["lost"] or got.link["silences"]:  # faults of the link explain any number
        explained = np.inf
    findings, parts, figures = [], [], {}
    for hub, t in got.times.items():
        where = f"hub {hub}"
        if len(t) < SCANS_MIN:
            what = f"fewer than {SCANS_MIN} whole scans"
            findings.append(Finding(where, what, "see the link, or give more --seconds"))
            continue
        missed, period_ms, off_ms = _pace(t, got.span[1])
        due, (p50, p95, p99) = len(t) + missed, off_ms
        parts.append(
            f"{where}: {1e3 / period_ms:.1f} Hz of {1e3 / got.period_ms:.1f} asked, "
            f"{p50:.1f} / {p95:.1f} / {p99:.1f} ms off (50 / 95 / 99 %), {missed} of {due} missed"
        )
        figures[str(hub)] = {
            "scans": len(t),
            "missed": missed,
            "period_ms": period_ms,
            "off_ms": off_ms,
        }
        slow = period_ms - got.period_ms
        if abs(slow) > RATE_OFF * got.period_ms:
            what = f"a scan every {period_ms:.1f} ms, where {got.period_ms} were asked for"
            findings.append(Finding(where, what, cures.FEWER if slow > 0 else cures.HOST))
        if p99 > JITTER_OFF * period_ms:
            what = f"one scan in a hundred is {p99:.1f} ms or more off its time"
            findings.append(Finding(where, what, cures.BUSY))
        if missed - explained > MISSED * due:
            what = f"{missed} of {due} scans did not come, and no damaged packet explains it"
            findings.append(Finding(where, what, f"{cures.FEWER}; else {cures.BUSY}"))
    return CheckResult("; ".join(parts) or "too few scans", findings, figures=figures)


def _pace(t: Floats, end_s: float) -> tuple[int, float, list[float]]:
    """Scans missed, the median period [ms], and how far 50, 95 and 99 % of the intervals are off a
    multiple of it [ms]; of scans at times (n,) [s], listened for until `end_s`."""
    interval = np.diff(t)
    period = float(np.median(interval))
    periods = np.round(interval / period)
    silent_at_end = max(int((end_s - t[-1]) / period) - 1, 0)
    missed = int((np.maximum(periods, 1) - 1).sum()) + silent_at_end
    off_ms = np.percentile(1e3 * np.abs(interval - periods * period), (50, 95, 99))
    return missed, 1e3 * period, off_ms.tolist()


def link(got: Received) -> CheckResult:
    """Whole packets with the right checksum and indices, from an adapter that stays."""
    count, packets = got.link, got.link["packets"] + got.damaged
    if not got.scans:
        return CheckResult("no scan came", checked=False)
    findings = [*_bus(count)]
    if gone := _counted(count, "lost", "silences"):
        findings.append(Finding("the adapter", gone, cures.ADAPTER))
    if got.damaged > DAMAGED * packets or count["orphan"] > DAMAGED * count["frames"]:
        cure = cures.TABLE if got.damaged == count["index_errors"] > 0 else cures.WIRES
        findings.append(Finding("the bus", _counted(count, *DAMAGES, "orphan"), cure))
    note = _counted(count, "unknown", "unsent", "refused")
    summary = (
        f"{packets} packets, wrong: checksum {count['crc_errors']}, "
        f"length {count['length_errors']}, index {count['index_errors']}"
    )
    return CheckResult(summary, findings, [note] * bool(note), dict(count))


def _bus(count: Counter[str]) -> Iterator[Finding]:
    for fault in BusFault:
        if fault not in NORMAL and (times := count[f"bus_{fault}"]):
            what, _, cure = fault.line.partition("; ")
            yield Finding("the bus", f"{what}: {times}", cure)


def noise(got: Received) -> CheckResult:
    """The readings of the untouched skin vary little."""
    idle, full = got.idle, got.full_scale_counts
    if not idle.usable.any():
        return CheckResult("no taxel that reads", checked=False)
    low, middle, high = np.percentile(idle.noise[idle.usable], (10, 50, 90)).tolist()

    def what(i: int) -> str:
        share = f"{100 * idle.noise[i] / full:.1f} % of full scale"
        return f"noise {idle.noise[i]:.0f} counts, {share}, where the skin's is {middle:.1f}"

    quiet = (
        "the noise is less than a count, so a taxel that stands still cannot be told from a quiet "
        "one: use --press"
    )
    summary = (
        f"{middle:.1f} counts (10..90 %: {low:.1f}..{high:.1f}), {100 * middle / full:.2f} % of "
        f"full scale; {idle.noisy.sum()} taxels too noisy"
    )
    findings = [*_by_module(got, idle.noisy, what, cures.GROUND)]
    figures = {"median": middle, "p10": low, "p90": high}
    return CheckResult(summary, findings, [quiet] * (middle < NOISE_TELLS), figures)


def taxels(got: Received) -> CheckResult:
    """Taxels that are dead, stuck or saturated."""
    idle, failing = got.idle, got.idle.failing
    if not idle.present.any():
        return CheckResult("no taxel of the layout was heard", checked=False)
    texts: dict[str, Callable[[int], str]] = {
        "dead": lambda i: f"reads 0 in {100 * idle.zero[i]:.0f} % of the scans",
        "stuck": lambda i: f"reads {idle.level[i]:.0f} without a count of change",
        "saturated": lambda i: (
            f"reads {INVALID_FROM} or more in {100 * idle.saturated[i]:.0f} % of the scans"
        ),
    }
    findings = [
        finding._replace(what=f"{kind}: {finding.what}")
        for kind, text in texts.items()
        for finding in _by_module(got, failing[kind], text, cures.TAXEL)
    ]
    counted = ", ".join(f"{mask.sum()} {kind}" for kind, mask in failing.items())
    level = idle.level[idle.present]
    summary = (
        f"{idle.present.sum()} of {len(got.layout)} heard: {counted}; "
        f"idle levels {level.min():.0f}..{level.max():.0f} counts"
    )
    figures = {kind: np.flatnonzero(mask).tolist() for kind, mask in failing.items()}
    return CheckResult(summary, findings, figures=figures)


def temperature(got: Received) -> CheckResult:
    """The modules' T0: a valid reading that moves as slowly as a temperature."""
    found = got.idle.temperature
    if not found:
        return CheckResult("no T0 was heard", checked=False)
    findings = []
    for sui, t0 in sorted(found.items()):
        what = ""
        if t0.invalid > INVALID:
            what = f"0, or {INVALID_FROM} and more, in {100 * t0.invalid:.0f} % of the scans"
        elif t0.step > t0.allowed:
            what = f"jumped by {t0.step:.0f} counts within a second, more than {t0.allowed:.0f}"
        if what:
            findings.append(Finding(f"T0 of {got.module(sui)}", what, cures.T0))
    level, step = [t0.level for t0 in found.values()], max(t0.step for t0 in found.values())
    summary = (
        f"T0 of {len(found)} modules: {min(level):.0f}..{max(level):.0f} counts, "
        f"at most {step:.0f} counts in a second"
    )
    return CheckResult(summary, findings)


def press(got: Received) -> CheckResult:
    """Each module answers where the layout has it, as strongly as the daemon expects."""
    if not got.presses:
        why = "not asked for (--press)" if got.presses is None else "no module that can be pressed"
        return CheckResult(why, checked=False)
    full = got.full_scale_counts
    answers = {p.asked: p.answered for p in got.presses}
    peaks = {p.asked: float(p.peak.max()) for p in got.presses}
    findings = []
    for asked, answered in answers.items():
        if answered is None:
            what = "nothing was felt when it was to be pressed"
            findings.append(Finding(got.module(asked), what, cures.PRESS))
        elif answers.get(answered) == asked < answered:
            where = f"modules {asked} and {answered}"
            what = "answer for each other: they are swapped"
            findings.append(Finding(where, what, cures.SWAPPED))
        elif answers.get(answered) != asked != answered:
            what = f"module {answered} answered when it was pressed"
            findings.append(Finding(got.module(asked), what, cures.PRESS))
    weak = [asked for asked in peaks if answers[asked] is not None and peaks[asked] < WEAK * full]
    if weak:
        where = f"modules {_listed(weak)}"
        most = max(peaks[asked] for asked in weak)
        what = f"felt {most:.0f} counts at most, under {100 * WEAK:.0f} % of full scale"
        findings.append(Finding(where, what, cures.HARDER))
    figures = {str(asked): answered for asked, answered in answers.items()}
    right, strongest = sum(a == b for a, b in answers.items()), max(peaks.values())
    strong = (
        f"the strongest press is {strongest / full:.1f} times full scale; where such presses are "
        f"to be told apart, raise full_scale_counts towards {strongest:.0f}"
    )
    summary = (
        f"{right} of {len(answers)} modules answered where they are; strongest {strongest:.0f} "
        f"counts, {100 * strongest / full:.0f} % of full scale"
    )
    return CheckResult(summary, findings, [strong] * (strongest > STRONG * full), figures)


CHECKS: dict[str, Callable[[Received], CheckResult]] = {
    "discovery": discovery,
    "modules": modules,
    "rate": rate,
    "link": link,
    "noise": noise,
    "taxels": taxels,
    "temperature": temperature,
    "press": press,
}


def _by_module(
    got: Received, bad: Bools, what: Callable[[int], str], cure: str
) -> Iterator[Finding]:
    """One finding for each module with bad taxels (M,): a module that fails is one fault."""
    uid, serial = got.layout.uid, got.layout.uid >> 4
    for sui in np.unique(serial[bad]).tolist():
        failed = np.flatnonzero(bad & (serial == sui))
        failed = failed[np.argsort(uid[failed])]
        names = [f"T{uid[i] & 0xF}" for i in failed]
        text = what(failed[0])
        if len(failed) > 1:
            text += f" ({names[0]}; the others alike)"
        whole = len(failed) == (serial == sui).sum() > 1
        where = f"{_listed(names)} of {got.module(sui)}"
        yield Finding(where, text, cures.MODULE if whole else cure)


def _counted(count: Counter[str], *names: str) -> str:
    """The counters that are not 0, in words."""
    return ", ".join(f"{cures.COUNTED[name]}: {count[name]}" for name in names if count[name])


def _listed(names: Sequence[object]) -> str:
    more = len(names) - NAMES_MAX
    return ", ".join(map(str, names[:NAMES_MAX])) + (f" and {more} more" if more > 0 else "")
