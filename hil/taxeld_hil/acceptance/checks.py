"""The acceptance rules, as functions of what was received."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.skin.channels import TEMPERATURE
from taxeld.skin.drift import T0_STEP
from taxeld.skin.rest import FROZEN_SCANS, NOISE_TELLS
from taxeld.skin.skin import INVALID_FROM
from taxeld.source.bus_faults import NORMAL, BusFault
from taxeld_hil.acceptance.received import INVALID, STANDS_OUT, Received
from taxeld_hil.rules import Rule, at_least
from taxeld_protocol.array import Group
from taxeld_protocol.decoder import GAP_SHARE
from taxeld_protocol.modules import NAMES, Module, wired

RATE_OFF = 0.1  # share of the period; a hub's clock is far better
JITTER_OFF = 1.0 - GAP_SHARE  # share of the period: an earlier scan may join the last one
MISSED = 0.01  # share of the scans, without a damaged packet to explain them
SCANS_MIN = 10  # scans that tell the rate of a hub
LEARN_SCANS = 60  # scans in which some taxel of a quiet skin gets its baseline
T0_KNOWN_S = 3.0  # time after which a T0 is known
T0_NOISE = 10.0  # times the median change of a T0: its noise changes it less
DAMAGED = 0.001  # share of the packets; CAN repeats damaged frames, so none should be
WEAK = 0.1  # full scales; a taxel's strongest on a real skin is 0.43 (median)
STRONG = 1.5  # full scales: activations end at 1, so stronger presses read the same
NAMES_MAX = 12  # names in one line

POWER = "check that the hub has power, CAN-H and CAN-L, 1 Mbit/s, and 120 Ω at the bus's ends"
KIND = "check the target's kind (can, slcan or serial) and its bit rate or baud rate"
ADAPTER = "check the adapter's plug, cable and supply, and that no other program uses it"
HOST = "stop any other host that drives this hub, and switch the hub off and on"
FIRMWARE = "switch the hub off and on; else load its firmware anew, with the vendor's tool"
SPI = "check the cable from the hub to the module and its neighbours; switch the hub off and on"
LAYOUT = "give this skin's layout file, or correct the serial numbers in it"
FEWER = "ask for fewer scans (--period-ms, and source.period_ms of the daemon)"
BUSY = (
    "close other programs on this machine; on a USB serial adapter set its latency timer to 1 ms "
    "(/sys/bus/usb-serial/devices/*/latency_timer)"
)
# Counters have their names in the daemon's health.
DAMAGES = ("crc_errors", "length_errors", "index_errors", "malformed", "noise")
AWAY = ("lost", "silences")
# No hub declares its modules: the first counter that is not 0 has the cure.
SILENCE = {
    "lost": ADAPTER,
    "bootloader": FIRMWARE,
    "packets": HOST,
    "frames": KIND,
    "refused": ADAPTER,
    "bytes": KIND,
    "unsent": POWER,
}


def rules(got: Received) -> list[Rule]:
    """All rules, in the order of the report."""
    checks = (discovery, modules, rate, link, taxels, temperature, press)
    return [rule for check in checks for rule in check(got)]


def discovery(got: Received) -> Iterator[Rule]:
    """The hub answers the daemon's own bring-up, declares all its modules, and sends scans."""
    fault, cure = ("", "") if got.scans else _bus(got.bring_up)
    if not got.tables:
        said = fault or _counted(got.bring_up, SILENCE) or "nothing at all was heard"
        cures = [cure for name, cure in SILENCE.items() if got.bring_up[name]]
        cure = cure or [*cures, POWER][0]
        yield Rule("discovery", "hubs", f"none declared its modules; {said}", "any", False, cure)
        return
    parts, unknown, silent = [], [], [fault] * bool(fault)
    for hub, table in got.tables.items():
        connected = [module for module in table if module.channels]
        channels = sum(module.channels for module in connected)
        parts.append(f"hub {hub}: {len(connected)} modules, {channels} channels")
        lacking = [i for i, module in enumerate(table) if module.channels and module.sui is None]
        if lacking or not connected:
            where = f"of the modules at positions {_listed(lacking)}" if lacking else "of a module"
            unknown.append(f"hub {hub} told nothing {where}")
        elif not any(scan.ihb == hub for scan in got.scans) and not any(m.fault for m in table):
            silent.append(f"hub {hub}")
    parts += [f"hub {hub}: {versions}" for hub, versions in got.firmware.items()]
    yield Rule("discovery", "hubs", "; ".join(parts), "any")
    yield _none("discovery", "without a module's details", unknown, SPI)
    yield _none("discovery", "sent no scan after auto sync", silent, cure or FIRMWARE)


def modules(got: Received) -> Iterator[Rule]:
    """The modules that answered are those of the layout, with the layout's taxels and T0."""
    connected = [m for table in got.tables.values() for m in table if m.channels]
    found = {m.sui: m for m in connected if m.sui is not None}
    layout = {m.sui: m for m in wired(got.layout.uid.tolist()) if m.sui is not None}
    if not found:
        yield Rule("modules", "of the layout", "no module is known", "all", None)
        return
    missing, unexpected = sorted(layout.keys() - found), sorted(found.keys() - layout)
    answered = f"{len(layout) - len(missing)} of {len(layout)} answered"
    if missing:
        unread = sum(layout[sui].channels - 1 for sui in missing)  # without T0
        answered += f"; {_listed(missing)} did not, so {unread} taxels are not read"
    yield Rule("modules", "of the layout", answered, "all", not missing, f"{SPI}; else {LAYOUT}")
    yield _none("modules", "not in the layout", [*map(got.module, unexpected)], LAYOUT)
    times = Counter(m.sui for m in connected)
    twice = [f"{got.module(sui)}, {times[sui]} times" for sui in found if times[sui] > 1]
    yield _none("modules", "with one serial number", twice, "give each its own number")
    said = {i: m.fault or _other(layout.get(i, m), m) for i, m in found.items()}
    other = [f"{got.module(sui)} {text}" for sui, text in said.items() if text]
    cure = "set the module's mask (MODULE_SET_CUT_SENSORS; bit 0 is T0), or mark its taxels as cut"
    yield _none("modules", "with other taxels", other, cure)


def _other(layout: Module, found: Module) -> str:
    """How a module's taxels differ from the layout's; the daemon passes over further ones."""
    absent = layout.mask & ~found.mask & ~(1 << TEMPERATURE)
    names = ", ".join(f"T{bit}" for bit in range(NAMES) if absent >> bit & 1)
    said = f"leaves out {names}, which the layout has" if absent else ""
    if not (found.mask >> TEMPERATURE & 1 or isinstance(found, Group)):  # an array has none
        said += " has no T0: its drift cannot be told from a touch"
    return said


def rate(got: Received) -> Iterator[Rule]:
    """Scans come as often as they were asked for, evenly, and none is missing."""
    if not got.scans:
        yield Rule("rate", "scans", "none came", "", None)
    count, asked_ms = got.link, got.period_ms
    explained: float = sum(count[name] for name in (*DAMAGES, "orphan"))
    if _counted(count, AWAY):  # faults of the link explain any number
        explained = np.inf
    for hub in sorted({scan.ihb for scan in got.scans}):
        t = np.array([scan.t for scan in got.scans if scan.ihb == hub and scan.complete])
        if len(t) < SCANS_MIN:
            cure = "see the link, or give more --seconds"
            yield at_least("rate", f"whole scans of hub {hub}", len(t), SCANS_MIN, cure)
            continue
        missed, period_ms, off_ms = _pace(t, got.span[1])
        due, most_ms = len(t) + missed, JITTER_OFF * period_ms
        is_right = abs(period_ms - asked_ms) <= RATE_OFF * asked_ms
        every, limit = f"a scan every {period_ms:.1f} ms", f"{asked_ms} ms ± {RATE_OFF:.0%}"
        cure = FEWER if period_ms > asked_ms else HOST
        yield Rule("rate", f"hub {hub}", every, limit, is_right, cure)
        said = f"99 % of the scans are within {off_ms:.1f} ms"
        limit, is_even = f"at most {most_ms:.1f} ms", off_ms <= most_ms
        yield Rule("rate", f"evenness of hub {hub}", said, limit, is_even, BUSY)
        said, limit = f"{missed} of {due} scans", f"at most {MISSED:.0%}, and damaged packets"
        is_whole, cure = missed - explained <= MISSED * due, f"{FEWER}; else {BUSY}"
        yield Rule("rate", f"missed by hub {hub}", said, limit, is_whole, cure)


def _pace(t: Floats, end_s: float) -> tuple[int, float, float]:
    """Scans missed, the median period [ms], and how far 99 % of the intervals are at most off a
    multiple of it [ms]; of scans at times (n,) [s], listened for until `end_s`."""
    interval = np.diff(t)
    period = float(np.median(interval))
    periods = np.round(interval / period)
    silent_at_end = max(int((end_s - t[-1]) / period) - 1, 0)
    missed = int((np.maximum(periods, 1) - 1).sum()) + silent_at_end
    off_ms = np.percentile(1e3 * np.abs(interval - periods * period), 99)
    return missed, 1e3 * period, float(off_ms)


def link(got: Received) -> Iterator[Rule]:
    """Whole packets with the right checksum and indices, from an adapter that stays."""
    count = got.link
    if not got.scans:
        yield Rule("link", "packets", "none came", "", None)
        return
    fault, cure = _bus(count)
    gone = [words for words in (fault, _counted(count, AWAY)) if words]
    yield _none("link", "faults", gone, cure or ADAPTER)
    damaged = sum(count[name] for name in DAMAGES)
    packets = count["packets"] + damaged
    bad = damaged > DAMAGED * packets or count["orphan"] > DAMAGED * count["frames"]
    said = ", ".join(filter(None, (f"{packets} packets", _counted(count, (*DAMAGES, "orphan")))))
    cure = f"check the bus's ends (120 Ω at both), its shield and its stubs; else {BUSY}"
    if damaged == count["index_errors"] > 0:
        cure = "two hubs may share a short id: connect one at a time, and switch it off and on"
    yield Rule("link", "damage", said, f"at most {DAMAGED:.1%} of the packets", not bad, cure)


def _bus(count: Counter[str]) -> tuple[str, str]:
    """The faults of the bus, and the cure of the gravest; empty without any."""
    faults = [f for f in BusFault if f not in NORMAL and count[f"bus_{f}"]]
    said = ", ".join(f"{f.line.partition('; ')[0]}: {count[f'bus_{f}']}" for f in faults)
    return said, faults[0].line.partition("; ")[2] if faults else ""


def taxels(got: Received) -> Iterator[Rule]:
    """Each taxel reads something, varies a little, and is neither stuck nor saturated."""
    ground = (
        "run once more with the skin untouched; then check the ground between skin, hub and robot, "
        "and keep motor cables away; a single taxel can be marked as cut in the layout"
    )
    read = got.untouched
    known = None if read is None else read.fine & ~np.isnan(read.level)
    if read is None or known is None or not known.any():
        suis = {m.sui for table in got.tables.values() for m in table}
        is_long = sum(scan.complete for scan in got.scans) >= LEARN_SCANS
        holds = False if is_long and suis & {*(got.layout.uid >> 4).tolist()} else None
        yield Rule("taxels", "at rest", "no taxel has a baseline", "some", holds, ground)
        return
    level, usual = read.level[known], float(np.median(read.noise[known]))
    said = (
        f"{len(level)} of {len(got.layout)}, at {level.min():.0f} to {level.max():.0f} counts; "
        f"noise {usual:.1f} counts (median)"
    )
    if usual < NOISE_TELLS:
        said += ", so a stuck taxel looks like a quiet one: use --press"
    yield Rule("taxels", "at rest", said)
    cure = (
        "check that the module's dielectric is on and dry and that its surface is not cut; if only "
        "this taxel fails, mark it as cut in the layout; if the whole module fails, check its "
        "cable and supply, then replace it"
    )
    limits = {
        "saturated": (f"at most {INVALID:.0%} of the scans at {INVALID_FROM} counts", cure),
        "dead": (f"at most {INVALID:.0%} of the scans at 0", cure),
        "stuck": (f"a change within {FROZEN_SCANS} scans", cure),
        "noisy": (f"a baseline, and at most {STANDS_OUT:g} times the median", ground),
    }
    for fault, (limit, cure) in limits.items():
        bad = [*_by_module(got, read.faults[fault], read.noise)]
        yield _none("taxels", fault, bad, cure, limit)


def _by_module(got: Received, bad: Bools, noise: Floats) -> Iterator[str]:
    """Bad taxels (M,), a part for each module: a module that fails is one fault."""
    uid, serial = got.layout.uid, got.layout.uid >> 4
    for sui in np.unique(serial[bad]).tolist():
        own = bad & (serial == sui)
        names = _listed([f"T{name}" for name in sorted((uid[own] & 0xF).tolist())])
        whole = "the whole module: " if own.sum() == (serial == sui).sum() > 1 else ""
        most = noise[own].max()
        reads = f"noise {most:.0f} counts" if most >= 0.0 else "without a baseline"
        yield f"{whole}{names} of {got.module(sui)}, {reads}"


def temperature(got: Received) -> Iterator[Rule]:
    """The modules' T0: a valid reading that moves as slowly as a temperature."""
    suis = np.unique(got.layout.uid >> 4)
    tables = [m for table in got.tables.values() for m in table if not isinstance(m, Group)]
    with_t0 = {m.sui for m in tables if m.mask >> TEMPERATURE & 1}
    known = np.array([sui in with_t0 for sui in suis.tolist()])
    if got.untouched is None or not known.any() or got.span[1] - got.span[0] < T0_KNOWN_S:
        yield Rule("temperature", "T0", "none was heard", "", None)
        return
    t0 = got.untouched.t0[:, known]
    suis, lost = suis[known].tolist(), np.isnan(t0[-1])
    steps, most = np.nan_to_num(np.abs(np.diff(t0, axis=0))), T0_STEP * got.full_scale_counts
    step = np.where(steps > T0_NOISE * np.median(steps, axis=0), steps, 0.0).max(axis=0)
    cure = "run once more, untouched; then check the module's supply. Its drift is not compensated"
    where = [f"T0 of {got.module(sui)}" for sui in suis]
    invalid = [name for name, bad in zip(where, lost, strict=True) if bad]
    yield _none("temperature", f"0, or {INVALID_FROM} and more", invalid, cure)
    jumps = [f"{name}: {by:.0f} counts" for name, by in zip(where, step, strict=True) if by > most]
    yield _none("temperature", "jumps within a second", jumps, cure, f"at most {most:.0f} counts")


def press(got: Received) -> Iterator[Rule]:
    """Each module answers where the layout has it, as strongly as the daemon expects."""
    if not got.presses:
        why = "not asked for (--press)" if got.presses is None else "no module that can be pressed"
        yield Rule("press", "modules", why, "", None)
        return
    full, answers = got.full_scale_counts, {p.asked: p.answered for p in got.presses}
    strength = {p.asked: float(p.peak.max()) for p in got.presses if p.answered is not None}
    wrong = list[str]()
    for asked, answered in answers.items():
        if answered is None:
            wrong.append(f"{got.module(asked)} felt nothing")
        elif answers.get(answered) != asked:
            wrong.append(f"module {answered} answered for {asked}")
        elif asked < answered:
            wrong.append(f"modules {asked} and {answered} are swapped")
    right = sum(a == b for a, b in answers.items())
    said = "; ".join([f"{right} of {len(answers)} modules answered where they are", *wrong])
    cure = "exchange swapped modules, or their serial numbers in the layout; press others once more"
    yield Rule("press", "answers", said, "all", not wrong, cure)
    strongest = max(strength.values(), default=0.0)
    weak = [asked for asked, counts in strength.items() if counts < WEAK * full]
    said = f"strongest {strongest:.0f} counts, {strongest / full:.0%} of full scale"
    if weak:
        said += f"; modules {_listed(weak)} felt {max(strength[w] for w in weak):.0f} at most"
    if strongest > STRONG * full:
        said += "; to tell such presses apart, raise full_scale_counts towards it"
    cure = "press harder once more; else set skin.full_scale_counts to what a firm press reads"
    yield Rule("press", "strength", said, f"at least {WEAK:.0%} of full scale", not weak, cure)


def _none(check: str, what: str, found: Sequence[str], cure: str, limit: str = "none") -> Rule:
    """The rule that nothing is so, or beyond the limit."""
    return Rule(check, what, _listed(found, "; ") or "none", limit, not found, cure)


def _counted(count: Counter[str], names: Iterable[str]) -> str:
    """The counters that are not 0."""
    return ", ".join(f"{name} {count[name]}" for name in names if count[name])


def _listed(names: Sequence[object], comma: str = ", ") -> str:
    more = len(names) - NAMES_MAX
    return comma.join(map(str, names[:NAMES_MAX])) + (f" and {more} more" if more > 0 else "")
