"""The acceptance rules, as functions of what a recording has of a skin."""

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.model.noise import FLOOR
from taxeld.skin.channels import TEMPERATURE
from taxeld.skin.drift import T0_STEP
from taxeld.skin.rest import FROZEN_SCANS, NOISE_MAX, NOISE_TELLS
from taxeld.skin.skin import INVALID_FROM
from taxeld_hil.acceptance.recorded import RecordedSkin
from taxeld_hil.rules import Rule, at_least
from taxeld_protocol.array import Group
from taxeld_protocol.decoder import GAP_SHARE

RATE_OFF = 0.1  # share of the period; a hub's clock is far better
JITTER_OFF = 1.0 - GAP_SHARE  # share of the period: an earlier scan may join the last one
MISSED = 0.01  # share of the scans
SCANS_MIN = 10  # scans that tell the rate of a hub
REST_S = 5.0  # 100 scans at the usual rate
INVALID = 0.01  # share of a taxel's scans
T0_LOOKS = 3  # after which a T0 is known
T0_NOISE = 10.0  # times the median change of a T0: its noise changes it less
DAMAGED = 0.001  # share of the packets; CAN repeats damaged frames, so none should be
STANDS_OUT = 10.0  # times the skin's median noise; 23..59 counts is what 80 % of a skin lie in
WEAK = 0.1  # full scales; a taxel's strongest on a real skin is 0.43 (median)
STRONG = 1.5  # full scales: activations end at 1, so stronger presses read the same
NAMES_MAX = 12  # names in one line

HUB = (
    "'taxeld record' says why while it waits; check that the hub has power, and the adapter's kind"
)
FIRMWARE = "switch the hub off and on; else load its firmware anew, with the vendor's tool"
SPI = "check the cable from the hub to the module and its neighbours; switch the hub off and on"
LAYOUT = "give this skin's layout file (--layout), or correct the serial numbers in it"
MASK = (
    "set the modules' masks (MODULE_SET_CUT_SENSORS; bit 0 is T0), or mark those taxels as cut in "
    "the layout"
)
RATE = (
    "ask for fewer scans (source.period_ms); stop any other host that drives this hub, and switch "
    "it off and on"
)
BUSY = (
    "close other programs on this machine; on a USB serial adapter set its latency timer to 1 ms "
    "(/sys/bus/usb-serial/devices/*/latency_timer)"
)
BUS = f"check the bus's ends (120 Ω at both), its shield and its stubs; else {BUSY}"
IDS = "two hubs may share a short id: connect one at a time, and switch it off and on"
GROUND = (
    "record once more; then check the ground between skin, hub and robot, and keep motor cables "
    "away; a single taxel can be marked as cut in the layout"
)
SURFACE = (
    "check that the module's dielectric is on and dry and that its surface is not cut; if only "
    "this taxel fails, mark it as cut in the layout; if the whole module fails, check its cable "
    "and supply, then replace it"
)
SUPPLY = "record once more; then check the module's supply. Its drift is not compensated"
PRESS = "press them once more, and harder; then check their cables"
WEAKER = f"{PRESS}; else set skin.full_scale_counts to what a firm press reads"
# counters have their names in the daemon's health
DAMAGES = ("crc_errors", "length_errors", "index_errors", "malformed")


def rules(got: RecordedSkin) -> list[Rule]:
    """All rules, in the order of the report."""
    checks = (modules, rate, link, taxels, temperature, press)
    return [rule for check in checks for rule in check(got)]


def modules(got: RecordedSkin) -> Iterator[Rule]:
    """Hubs send scans, of the modules of the layout, each with all of its taxels and a T0."""
    said = "; ".join(
        f"hub {hub}: {sum(bool(m.channels) for m in table)} modules, "
        f"{sum(m.channels for m in table)} channels"
        for hub, table in got.tables.items()
    )
    yield Rule("modules", "hubs", said or "none sent a scan", "any", bool(said), HUB)
    yield _none("modules", "refused", [got.refusal][: bool(got.refusal)], FIRMWARE)
    yield _none("modules", "of hubs that sent no scan", [f"hub {h}" for h in got.silent], FIRMWARE)
    wiring, known = got.skin.wiring, bool(got.tables)
    answered = f"{len(wiring.suis) - len(wiring.lacking)} of {len(wiring.suis)} answered"
    if wiring.lacking:
        unread = int(np.isin(got.layout.uid >> 4, wiring.lacking).sum())
        answered += f"; {_listed(wiring.lacking)} did not, so {unread} taxels are not read"
    holds = not wiring.lacking if known else None
    yield Rule("modules", "of the layout", answered, "all", holds, f"{SPI}; else {LAYOUT}")
    foreign = [got.module(sui) for sui in wiring.foreign]
    yield _none("modules", "not in the layout", foreign, LAYOUT)
    times = Counter(m.sui for table in got.tables.values() for m in table if m.channels)
    twice = [f"{got.module(sui)}, {n} times" for sui, n in times.items() if sui and n > 1]
    yield _none("modules", "with one serial number", twice, "give each its own number")
    absent = (got.came == 0.0) & ~np.isin(got.layout.uid >> 4, wiring.lacking)
    left_out = [*_by_module(got, absent if known else absent & False)]
    yield _none("modules", "that leave out taxels", left_out, MASK)


def rate(got: RecordedSkin) -> Iterator[Rule]:
    """Scans come as often as they were asked for, evenly, and none is missing."""
    for hub, times in got.times.items():
        t, asked_ms = np.array(times), got.period_ms
        if len(t) < SCANS_MIN:
            yield at_least("rate", f"whole scans of hub {hub}", len(t), SCANS_MIN, "record longer")
            continue
        missed, period_ms, off_ms = _pace(t, got.end_t)
        due, most_ms = len(t) + missed, JITTER_OFF * period_ms
        is_right = abs(period_ms - asked_ms) <= RATE_OFF * asked_ms
        every, limit = f"a scan every {period_ms:.1f} ms", f"{asked_ms} ms ± {RATE_OFF:.0%}"
        yield Rule("rate", f"hub {hub}", every, limit, is_right, RATE)
        said, limit = f"99 % of the scans are within {off_ms:.1f} ms", f"at most {most_ms:.1f} ms"
        yield Rule("rate", f"evenness of hub {hub}", said, limit, off_ms <= most_ms, BUSY)
        said, limit, cure = f"{missed} of {due} scans", f"at most {MISSED:.0%}", f"{RATE}; {BUSY}"
        yield Rule("rate", f"missed by hub {hub}", said, limit, missed <= MISSED * due, cure)


def _pace(t: Floats, end_s: float) -> tuple[int, float, float]:
    """Scans missed, the median period [ms], and how far 99 % of the intervals are at most off a
    multiple of it [ms]; of scans at times (n,) [s], recorded until `end_s`."""
    interval = np.diff(t)
    period = float(np.median(interval))
    periods = np.round(interval / period)
    silent_at_end = max(int((end_s - t[-1]) / period) - 1, 0)
    missed = int((np.maximum(periods, 1) - 1).sum()) + silent_at_end
    off_ms = np.percentile(1e3 * np.abs(interval - periods * period), 99)
    return missed, 1e3 * period, float(off_ms)


def link(got: RecordedSkin) -> Iterator[Rule]:
    """Packets come whole, with the right checksum and indices."""
    count = got.link
    damaged, packets = sum(count[name] for name in DAMAGES), count["packets"]
    named = [f"{name} {count[name]}" for name in (*DAMAGES, "orphan") if count[name]]
    # a recording may begin within a packet
    bad = damaged > 1 + DAMAGED * packets or count["orphan"] > DAMAGED * count["frames"]
    said, limit = ", ".join([f"{packets} packets", *named]), f"at most {DAMAGED:.1%} of the packets"
    cure = IDS if damaged == count["index_errors"] > 0 else BUS
    yield Rule("link", "damage", said, limit, not bad if packets else None, cure)


def taxels(got: RecordedSkin) -> Iterator[Rule]:
    """Each taxel reads something, varies a little, and is neither stuck nor saturated."""
    skin, rest_s = got.skin, got.rest_s
    state = skin.state()
    if state is None:
        yield Rule("taxels", "at rest", "no taxel has a baseline", "some", None, GROUND)
        return
    rest_s = got.end_t - got.begun_t if rest_s is None else rest_s
    touch = f"touch nothing at first; {_listed([*got.led][:1])} was the first module to be pressed"
    yield at_least("taxels", "seconds at rest", rest_s, REST_S, touch, ".1f")
    heard, often = got.came > 0.0, INVALID * got.came
    saturated = got.over > often
    dead = ~saturated & (got.unread - got.over > often)
    stuck = np.isin(np.arange(len(heard)), skin.faults()["stuck_taxels"])
    fine, unknown = heard & ~(saturated | dead | stuck), np.isnan(state.baseline)
    level, usual = state.baseline[fine & ~unknown], float(np.median(state.noise[fine & ~unknown]))
    said = (
        f"{len(level)} of {len(heard)}, at {level.min():.0f} to {level.max():.0f} counts; "
        f"noise {usual:.1f} counts (median)"
    )
    if usual < NOISE_TELLS:
        said += ", so a stuck taxel looks like a quiet one: press each"
    yield Rule("taxels", "at rest", said)
    # noise under which the daemon's threshold is the same for all taxels does not matter
    full, sigmas = skin.config.full_scale_counts, skin.config.threshold_sigmas
    limit = min(max(FLOOR * full / sigmas, STANDS_OUT * usual), NOISE_MAX * full)
    noise = np.where(unknown, np.nan, state.noise)
    noisy = fine & ~(noise <= limit)
    of_scans = f"at most {INVALID:.0%} of the scans"
    for what, bad, limit_said, cure in (
        ("saturated", saturated, f"{of_scans} at {INVALID_FROM} counts", SURFACE),
        ("dead", dead, f"{of_scans} at 0", SURFACE),
        ("stuck", stuck, f"a change within {FROZEN_SCANS} scans", SURFACE),
        ("noisy", noisy, f"a baseline, and noise of {limit:.0f} counts", GROUND),
    ):
        yield _none("taxels", what, [*_by_module(got, bad, noise)], cure, limit_said)


def _by_module(got: RecordedSkin, bad: Bools, noise: Floats | None = None) -> Iterator[str]:
    """Bad taxels (M,), a part for each module: a module that fails is one fault."""
    uid, serial = got.layout.uid, got.layout.uid >> 4
    for sui in np.unique(serial[bad]).tolist():
        own = bad & (serial == sui)
        names = _listed([f"T{name}" for name in sorted((uid[own] & 0xF).tolist())])
        whole = "the whole module: " if own.sum() == (serial == sui).sum() > 1 else ""
        reads = ""
        if noise is not None:
            most = noise[own].max()
            reads = f", noise {most:.0f} counts" if most >= 0.0 else ", without a baseline"
        yield f"{whole}{names} of {got.module(sui)}{reads}"


def temperature(got: RecordedSkin) -> Iterator[Rule]:
    """The modules' T0: there, with a valid reading that moves as slowly as a temperature."""
    found = [m for table in got.tables.values() for m in table if not isinstance(m, Group)]
    with_t0 = {m.sui: bool(m.mask >> TEMPERATURE & 1) for m in found}
    known = np.array([with_t0.get(sui, False) for sui in got.skin.wiring.suis])
    if not known.any() or len(got.t0) <= T0_LOOKS:
        yield Rule("temperature", "T0", "none was heard", "", None)
        return
    t0 = np.array(got.t0)[:, known]
    where = [f"T0 of {got.module(sui)}" for sui in np.array(got.skin.wiring.suis)[known].tolist()]
    lacking = [f"{got.module(sui)}" for sui, has in with_t0.items() if sui and not has]
    yield _none("temperature", "without T0", lacking, MASK)
    invalid = [name for name, lost in zip(where, np.isnan(t0[-1]), strict=True) if lost]
    yield _none("temperature", f"0, or {INVALID_FROM} and more", invalid, SUPPLY)
    steps, most = (
        np.nan_to_num(np.abs(np.diff(t0, axis=0))),
        T0_STEP * got.skin.config.full_scale_counts,
    )
    step = np.where(steps > T0_NOISE * np.median(steps, axis=0), steps, 0.0).max(axis=0)
    jumps = [f"{name}: {by:.0f} counts" for name, by in zip(where, step, strict=True) if by > most]
    yield _none("temperature", "jumps within a second", jumps, SUPPLY, f"at most {most:.0f} counts")


def press(got: RecordedSkin) -> Iterator[Rule]:
    """Each module that answers was pressed, and as strongly as the daemon expects."""
    wiring, full = got.skin.wiring, got.skin.config.full_scale_counts
    asked = [sui for sui in wiring.suis if sui not in wiring.lacking]
    if not got.led or not asked:
        yield Rule("press", "modules", "none was pressed", "all", None)
        return
    silent = [sui for sui in asked if sui not in got.led]
    said = f"{len(asked) - len(silent)} of {len(asked)} felt a press"
    said += f"; silent: {_listed([got.module(sui) for sui in silent])}" if silent else ""
    yield Rule("press", "modules", said, "all", not silent, PRESS)
    order = _listed([f"{sui} ({t - got.begun_t:.0f} s)" for sui, t in got.led.items()])
    yield Rule("press", "in this order", order, "as you pressed them: else modules are swapped")
    counts = {sui: float(got.peak[got.layout.uid >> 4 == sui].max()) for sui in got.led}
    strongest, weak = max(counts.values()), [s for s, most in counts.items() if most < WEAK * full]
    said = f"strongest {strongest:.0f} counts, {strongest / full:.0%} of full scale"
    if weak:
        said += f"; modules {_listed(weak)} felt {max(counts[sui] for sui in weak):.0f} at most"
    if strongest > STRONG * full:
        said += "; to tell such presses apart, raise full_scale_counts towards it"
    yield Rule("press", "strength", said, f"at least {WEAK:.0%} of full scale", not weak, WEAKER)


def _none(check: str, what: str, found: Sequence[str], cure: str, limit: str = "none") -> Rule:
    """The rule that nothing is so, or beyond the limit."""
    return Rule(check, what, _listed(found, "; ") or "none", limit, not found, cure)


def _listed(names: Sequence[object], comma: str = ", ") -> str:
    more = len(names) - NAMES_MAX
    return comma.join(map(str, names[:NAMES_MAX])) + (f" and {more} more" if more > 0 else "")
