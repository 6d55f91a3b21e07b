"""The acceptance checks, as functions of what was received: each fault fails its own check."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from taxeld.layout import read as layouts
from taxeld_hil.acceptance.accept import source_of
from taxeld_hil.acceptance.checks import CHECKS, CheckResult
from taxeld_hil.acceptance.press import pressed
from taxeld_hil.acceptance.received import Press, Received
from taxeld_hil.acceptance.report import AcceptanceReport
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.modules import Module

from .accept_skin import LAYOUT, MODULES, Counts

SKIN = layouts.read(LAYOUT)
SCANS, PERIOD_S = 200, 0.05
FULL_SCALE = 20_000.0
HEALTHY_LINK = Counter(frames=2400, packets=200)


def scans_of(
    counts: Counts, modules: tuple[Module, ...] = MODULES, times: Any = None, version: int = 1
) -> list[Scan]:
    t = 1000.0 + PERIOD_S * np.arange(SCANS) if times is None else times
    return [Scan(float(at), 1, tuple(counts.scan()), modules, version) for at in t]


def received(scans: list[Scan] | None = None, **more: Any) -> Received:
    """A healthy skin, but for what is given."""
    healthy: dict[str, Any] = {
        "layout": SKIN,
        "period_ms": 50,
        "full_scale_counts": FULL_SCALE,
        "tables": {1: MODULES},
        "bring_up": Counter(frames=20, packets=9),
        "link": HEALTHY_LINK,
        "scans": scans_of(Counts(MODULES)) if scans is None else scans,
        "span": (1000.0, 1000.0 + SCANS * PERIOD_S),
    }
    return Received(**{**healthy, **more})


def judged(got: Received) -> dict[str, CheckResult]:
    return {name: check(got) for name, check in CHECKS.items()}


def failed(got: Received) -> dict[str, str]:
    """The checks that fail, with all that they say."""
    return {
        name: " | ".join(" ".join(finding) for finding in check.findings)
        for name, check in judged(got).items()
        if check.verdict == "failed"
    }


def fixed(*faults: tuple[int, int, int]) -> Callable[[], Received]:
    """Taxels (SUI, name) that read some counts whatever happens."""

    def make() -> Received:
        counts = Counts(MODULES)
        counts.fixed = {(sui, name): value for sui, name, value in faults}
        return received(scans_of(counts))

    return make


def noise(channels: slice | int, sd: float) -> Callable[[], Received]:
    def make() -> Received:
        counts = Counts(MODULES)
        counts.noise[channels] = sd
        return received(scans_of(counts))

    return make


def table(*modules: Module) -> Callable[[], Received]:
    """A hub with other modules than the layout's."""
    return lambda: received(scans_of(Counts(modules), modules), tables={1: modules})


def times(change: Callable[[Any], Any]) -> Callable[[], Received]:
    def make() -> Received:
        t = change(1000.0 + PERIOD_S * np.arange(SCANS))
        span = (1000.0, max(float(t[-1]), 1000.0 + SCANS * PERIOD_S))
        return received(scans_of(Counts(MODULES), times=t), span=span)

    return make


def link(**counters: int) -> Callable[[], Received]:
    return lambda: received(link=HEALTHY_LINK + Counter(counters))


def presses(*answers: int | None, counts: float = 9000.0) -> Callable[[], Received]:
    made = [
        Press(asked, answered, np.full(len(SKIN), 0.0 if answered is None else counts))
        for asked, answered in enumerate(answers, 1)
    ]
    return lambda: received(presses=made)


def no_scans(tables: dict[int, tuple[Module, ...]], **bring_up: int) -> Callable[[], Received]:
    return lambda: received([], tables=tables, bring_up=Counter(bring_up), link=Counter())


def jumping_t0() -> Received:
    scans = scans_of(Counts(MODULES))
    late = [
        replace(s, counts=(s.counts[0] + 300, *s.counts[1:])) if i >= SCANS // 2 else s
        for i, s in enumerate(scans)
    ]
    return received(late)


A, B, C, D = MODULES

FAULTS: list[tuple[str, str, Callable[[], Received]]] = [
    # checks that fail, what the first must say, what is wrong
    ("discovery", "nothing at all was heard", no_scans({})),
    ("discovery", "could not be sent: 3", no_scans({}, unsent=3)),
    ("discovery", "CAN frames: 7", no_scans({}, frames=7)),
    ("discovery", "bytes: 40", no_scans({}, bytes=40)),
    ("discovery", "none of them an answer to DECLARE: 7", no_scans({}, frames=7, packets=7)),
    ("discovery", "went away: 1", no_scans({}, lost=1)),
    ("discovery", "refused, named above: 12", no_scans({}, refused=12, unsent=3)),
    ("discovery", "no module with a channel", no_scans({1: (Module(0),)})),
    ("discovery modules", "positions 1", no_scans({1: (A, Module(11), C, D)}, packets=4)),
    ("discovery", "sent no scan", no_scans({1: MODULES}, packets=9)),
    ("discovery", "acknowledges: 3 see that the skin", no_scans({}, bus_no_ack=3, unsent=9)),
    (
        "discovery",
        "bus-off, after too many errors: 1 check",
        no_scans({}, bus_off=1, bus_passive=1),
    ),
    ("link", "not read in time: 2 run as", link(bus_unread=2)),
    (
        "discovery",
        "hub 2 answers, but sent no scan",
        lambda: received(tables={1: (A, B, C), 2: (D,)}),
    ),
    ("modules", "module 2 did not answer; 10 taxels", table(A, C, D)),
    ("modules", "module 9 (hub 1, position 4)", table(*MODULES, replace(A, sui=9))),
    ("modules", "4 did not answer", table(A, B, C, replace(D, sui=9))),
    ("modules", "2 modules answer", table(A, B, C, D, D)),
    ("modules", "leaves out T9, T10", table(replace(A, mask=0x1FF, channels=9), B, C, D)),
    ("modules", "no T0", table(A, replace(B, mask=0x7FE, channels=10), C, D)),
    ("modules", "which taxel is which", table(A, B, C, replace(D, channels=10, mask=0x7FF))),
    ("rate", "80.0 ms, where 50", times(lambda t: 1000.0 + 1.6 * (t - 1000.0))),
    ("rate", "any other host", times(lambda t: 1000.0 + 0.5 * (t - 1000.0))),
    ("rate", "off its time", times(lambda t: t + 0.014 * (np.arange(len(t)) % 7 == 0))),
    ("rate", "10 of 200 scans", times(lambda t: np.delete(t, range(30, 130, 10)))),
    ("rate", "scans did not come", times(lambda t: t[:100])),
    ("rate", "fewer than 10", lambda: received(scans_of(Counts(MODULES))[:5])),
    ("link", "wrong checksum: 1", link(crc_errors=1)),
    ("link", "wrong length: 2", link(length_errors=2)),
    ("link", "short id", link(index_errors=3)),
    ("link", "command does not allow", link(malformed=1)),
    ("link", "could not decode", link(noise=1)),
    ("link", "without the beginning", link(orphan=40)),
    ("link", "went away: 2", link(lost=2)),
    (
        "link",
        "fell silent: 1",
        lambda: received(scans_of(Counts(MODULES))[:100], link=HEALTHY_LINK + Counter(silences=1)),
    ),
    (
        "link",
        "went away",
        lambda: received(scans_of(Counts(MODULES))[:100], link=HEALTHY_LINK + Counter(lost=1)),
    ),
    ("noise", "T5 of module 1 (hub 1, position 0)", noise(5, 500.0)),
    ("noise", "the whole module", noise(slice(12, 22), 500.0)),
    ("noise", "T1, T2, T3, T4, T5, T6, T7, T8, T9, T10 of module 4", noise(slice(0, 44), 1500.0)),
    ("taxels", "T4 of module 3 (hub 1, position 2) dead: reads 0", fixed((3, 4, 0))),
    ("taxels", "T2, T7 of module 1", fixed((1, 2, 0), (1, 7, 0))),
    ("taxels", "the whole module fails", fixed(*((2, name, 0) for name in range(1, 11)))),
    ("taxels", "saturated: reads 43000 or more in 100 %", fixed((4, 1, 43_000))),
    ("taxels", "stuck: reads 10123 without a count", fixed((4, 10, 10_123))),
    ("temperature", "T0 of module 2 (hub 1, position 1)", fixed((2, 0, 0))),
    ("temperature", "43000 and more, in 100 %", fixed((2, 0, 0xFFFF))),
    ("temperature", "jumped by", jumping_t0),
    ("press", "modules 2 and 4 answer for each other", presses(1, 4, 3, 2)),
    ("press", "module 3 answered when it was pressed", presses(2, 3, 1, 4)),
    ("press", "module 3 (hub 1, position 2) nothing was felt", presses(1, 2, None, 4)),
    ("press", "modules 1, 2, 3, 4 felt 900 counts", presses(1, 2, 3, 4, counts=900.0)),
]


def test_a_healthy_skin_fails_nothing() -> None:
    got = presses(1, 2, 3, 4)()
    assert failed(got) == {}
    assert {check.verdict for check in judged(got).values()} == {"passed"}


@pytest.mark.parametrize(
    ("name", "expected", "make"),
    FAULTS,
    ids=[f"{name}: {expected}" for name, expected, _ in FAULTS],
)
def test_a_fault_fails_its_own_check_alone_and_is_named(
    name: str, expected: str, make: Callable[[], Received]
) -> None:
    found = failed(make())
    assert list(found) == name.split()
    assert expected in found[name.split(maxsplit=1)[0]]


def test_a_swapped_pair_is_one_finding() -> None:
    assert failed(presses(1, 4, 3, 2)())["press"].count("swapped") == 1


def test_scans_lost_to_damaged_packets_fail_the_link_and_not_the_rate() -> None:
    scans = scans_of(Counts(MODULES))
    torn = [
        replace(scan, counts=(*scan.counts[:40], *[MISSING] * 4)) if i % 20 == 10 else scan
        for i, scan in enumerate(scans)
    ]
    got = received(torn, link=HEALTHY_LINK + Counter(crc_errors=10))
    assert list(failed(got)) == ["link"]
    assert "10 of 200 missed" in judged(got)["rate"].summary


def test_what_cannot_be_checked_has_not_passed() -> None:
    verdicts = {name: c.verdict for name, c in judged(no_scans({})()).items()}
    assert verdicts.pop("discovery") == "failed"
    assert set(verdicts.values()) == {"not checked"}


def test_a_module_table_is_compared_with_the_layout_without_scans_too() -> None:
    found = failed(no_scans({1: (A, C, D)}, packets=9)())
    assert list(found) == ["discovery", "modules"]
    assert "module 2 did not answer" in found["modules"]


def test_channels_that_the_layout_lacks_are_a_note_and_no_finding() -> None:
    more = replace(A, mask=0xFFF, channels=12)
    got = table(more, B, C, D)()
    assert failed(got) == {}
    assert judged(got)["modules"].notes == [
        "module 1 (hub 1, position 0): T11 are not in the layout; the daemon passes them over"
    ]


def test_with_less_noise_than_a_count_no_taxel_is_called_stuck_and_a_note_says_so() -> None:
    counts = Counts(MODULES, noise=0.2)
    counts.fixed = {(1, 3): 10_000}
    got = received(scans_of(counts))
    assert failed(got) == {}
    assert "use --press" in judged(got)["noise"].notes[0]


def test_noise_is_compared_with_the_skins_own() -> None:
    for sd in (0.5, 34.0, 130.0):  # a flat patch, a handle, a large curved patch
        assert failed(received(scans_of(Counts(MODULES, noise=sd)))) == {}


def test_slow_drift_fails_neither_the_noise_nor_the_temperature() -> None:
    scans = [
        replace(scan, counts=tuple(value + i // 20 for value in scan.counts))
        for i, scan in enumerate(scans_of(Counts(MODULES)))
    ]
    assert failed(received(scans)) == {}


@pytest.mark.parametrize("n", [1, 2, 3, 19, 21])
def test_with_few_scans_nothing_fails_but_the_rate(n: int) -> None:
    assert set(failed(received(scans_of(Counts(MODULES))[:n], span=(1000.0, 1000.0)))) <= {"rate"}


def test_presses_beyond_full_scale_are_a_note() -> None:
    got = presses(1, 2, 3, 4, counts=31_000.0)()
    assert failed(got) == {}
    assert "full_scale_counts towards 31000" in judged(got)["press"].notes[0]


def test_a_hub_that_declared_itself_twice_is_checked_by_its_last_table() -> None:
    dead = Counts(MODULES)
    dead.fixed = {(1, 1): 0}
    scans = scans_of(dead)[:100] + scans_of(Counts(MODULES), version=2)[100:]
    assert failed(received(scans)) == {}


RELEASED = (0,) * 8


def press_of(*counts: float, free: bool = True) -> float | None:
    """The most counts of the first press in a series of scans of one taxel."""
    scans = ((PERIOD_S * k, np.array([float(value)])) for k, value in enumerate(counts))
    peak = pressed(scans, np.array([50.0]), free=free)
    return None if peak is None else float(peak[0])


@pytest.mark.parametrize(
    ("counts", "free", "peak"),
    [
        ((0, 10, 49, 0, 60, 300, 200, *RELEASED, 900, 900), True, 300.0),
        ((60, 300, 200), True, 300.0),
        ((0, 400, 0, 0, 400, 0), True, None),
        ((400,) * 20, False, None),
        ((*(400,) * 20, *RELEASED, 70, 80, *RELEASED), False, 80.0),
    ],
    ids=["pressed and released", "not released", "single scans", "still held", "held, then again"],
)
def test_a_press_begins_over_the_threshold_of_a_free_skin_and_ends_with_its_release(
    counts: tuple[int, ...], free: bool, peak: float | None
) -> None:
    assert press_of(*counts, free=free) == peak


def test_the_json_is_strict_and_has_a_row_for_each_taxel() -> None:
    got = received(scans_of(Counts((A, B, C)), (A, B, C)), tables={1: (A, B, C)})
    report = AcceptanceReport("can:can0", "now", got)
    value = json.loads(report.json, parse_constant=pytest.fail)
    assert len(value["taxels"]) == len(SKIN)
    assert value["taxels"][-1]["noise"] is None
    assert value["passed"] is False


@pytest.mark.parametrize(
    ("target", "kind", "interface", "channel"),
    [
        ("can:can0", "can", "socketcan", "can0"),
        ("slcan:/dev/ttyACM0@3000000", "can", "slcan", "/dev/ttyACM0@3000000"),
        ("pcan:PCAN_USBBUS1", "can", "pcan", "PCAN_USBBUS1"),
        ("serial:/dev/ttyACM0@115200", "serial", "socketcan", "/dev/ttyACM0@115200"),
    ],
)
def test_a_target_is_one_of_the_daemons_sources(
    target: str, kind: str, interface: str, channel: str
) -> None:
    config = source_of(target, 20)
    assert (config.kind, config.interface, config.channel) == (kind, interface, channel)
    assert config.period_ms == 20
