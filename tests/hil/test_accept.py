"""The acceptance rules, as functions of what was received: a fault breaks its own rule alone."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from taxeld.layout import read as layouts
from taxeld_hil import rules
from taxeld_hil.acceptance import accept, checks
from taxeld_hil.acceptance.received import Press, Received, pressed
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.modules import Module

from .accept_skin import LAYOUT, MODULES, Counts

SKIN = layouts.read(LAYOUT)
SCANS, PERIOD_S = 300, 0.05
TIMES = 1000.0 + PERIOD_S * np.arange(SCANS)
SPAN = (1000.0, 1000.0 + SCANS * PERIOD_S)
LINK = Counter(frames=3600, packets=300)
A, B, C, D = MODULES
ALL_TAXELS = [i for i in range(44) if i % 11]  # channels, without those of T0

Make = Callable[[], Received]


def scans_of(
    modules: tuple[Module, ...] = MODULES, times: Any = TIMES, version: int = 1, **counts: Any
) -> list[Scan]:
    read = Counts(modules, **counts)
    return [Scan(float(t), 1, tuple(read.scan()), modules, version) for t in times]


def received(scans: list[Scan] | None = None, **more: Any) -> Received:
    """A healthy skin, but for what is given."""
    healthy: dict[str, Any] = {
        "layout": SKIN,
        "period_ms": 50,
        "full_scale_counts": 20_000.0,
        "tables": {1: MODULES},
        "bring_up": Counter(frames=20, packets=9),
        "link": LINK,
        "scans": scans_of() if scans is None else scans,
        "span": SPAN,
    }
    return Received(**{**healthy, **more})


def failed(got: Received) -> dict[str, str]:
    """The rules that do not hold, with all that they say."""
    return {
        f"{rule.check} {rule.what}": f"{rule.measured} → {rule.cure}"
        for rule in rules.failed(checks.rules(got))
    }


def counts(**given: Any) -> Make:
    return lambda: received(scans_of(**given))


def noise(channels: slice | list[int] | int, sd: float) -> Make:
    each = np.full(sum(m.channels for m in MODULES), 34.0)
    each[channels] = sd
    return counts(noise=each)


def table(*modules: Module) -> Make:
    """A hub with other modules than the layout's."""
    return lambda: received(scans_of(modules), tables={1: modules})


def times(t: Any, end: float = 0.0) -> Make:
    """Scans at times (n,), listened for until the last of them, or until `end`."""
    return lambda: received(scans_of(times=t), span=(SPAN[0], max(float(t[-1]), end)))


def link(scans: int = SCANS, **counters: int) -> Make:
    return lambda: received(scans_of(times=TIMES[:scans]), link=LINK + Counter(counters))


def presses(*answers: int | None, peak: float = 9000.0) -> Make:
    made = [
        Press(asked, answered, np.full(len(SKIN), 0.0 if answered is None else peak))
        for asked, answered in enumerate(answers, 1)
    ]
    return lambda: received(presses=made)


def silent(tables: dict[int, tuple[Module, ...]], **bring_up: int) -> Make:
    """A skin that sends no scan."""
    return lambda: received([], tables=tables, bring_up=Counter(bring_up), link=Counter())


def jumping_t0() -> Received:
    late = [
        replace(scan, counts=(scan.counts[0] + 300, *scan.counts[1:])) if i >= SCANS // 2 else scan
        for i, scan in enumerate(scans_of())
    ]
    return received(late)


HUBS, SILENT = "discovery hubs", "sent no scan after auto sync"
DETAILS = "without a module's details"
OF_LAYOUT, MORE, OTHER = "modules of the layout", "modules not in the layout", "with other taxels"
EVENNESS, MISSED, DAMAGE = "rate evenness of hub 1", "rate missed by hub 1", "link damage"
FAULTS: list[tuple[str, str, Make]] = [
    # rules that do not hold, what the first says, what is wrong
    (HUBS, "nothing at all was heard → check that the hub has power", silent({})),
    (HUBS, "frames 7 → check the target's kind", silent({}, frames=7)),
    (HUBS, "packets 7, frames 7 → stop", silent({}, frames=7, packets=7)),
    (HUBS, "lost 1 → check the adapter", silent({}, lost=1)),
    (HUBS, "refused 12, unsent 3 → check the adapter", silent({}, refused=12, unsent=3)),
    (HUBS, "acknowledges: 3 → see that the skin", silent({}, bus_no_ack=3, unsent=9)),
    (HUBS, "errors: 1, error-passive", silent({}, bus_off=1, bus_passive=1)),
    (f"discovery {SILENT}", "hub 1 → switch", silent({1: MODULES}, packets=9)),
    (f"discovery {SILENT}", "hub 2 →", lambda: received(tables={1: (A, B, C), 2: (D,)})),
    (f"discovery {SILENT}|{OF_LAYOUT}", "hub 1 → switch", silent({1: (A, C, D)}, packets=9)),
    (f"discovery {DETAILS}", "nothing of a module", silent({1: (Module(0),)})),
    (f"discovery {DETAILS}|{OF_LAYOUT}", "positions 1", silent({1: (A, Module(11), C, D)})),
    (OF_LAYOUT, "3 of 4 answered; 2 did not, so 10 taxels", table(A, C, D)),
    (MORE, "module 9 (hub 1, position 4)", table(*MODULES, replace(A, sui=9))),
    (f"{OF_LAYOUT}|{MORE}", "4 did not", table(A, B, C, replace(D, sui=9))),
    ("modules with one serial number", "position 3), 2 times", table(A, B, C, D, D)),
    (f"modules {OTHER}", "out T9, T10", table(replace(A, mask=0x1FF, channels=9), B, C, D)),
    (f"modules {OTHER}", "no T0", table(A, replace(B, mask=0x7FE, channels=10), C, D)),
    (f"modules {OTHER}", "not known; set", table(A, B, C, replace(D, channels=10, mask=0x7FF))),
    ("rate hub 1", "80.0 ms → ask for fewer", times(1000.0 + 1.6 * (TIMES - 1000.0))),
    ("rate hub 1", "25.0 ms → stop any other host", times(1000.0 + 0.5 * (TIMES - 1000.0))),
    (EVENNESS, "within 14.0 ms", times(TIMES + 0.014 * (np.arange(SCANS) % 7 == 0))),
    (MISSED, "10 of 300 scans", times(np.delete(TIMES, range(30, 130, 10)))),
    (MISSED, "149 of 299", times(TIMES[:150], TIMES[-1])),
    ("rate whole scans of hub 1", "5 → see the link", times(TIMES[:5])),
    (DAMAGE, "crc_errors 1 → check the bus's ends", link(crc_errors=1)),
    (DAMAGE, "index_errors 3 → two hubs may share a short id", link(index_errors=3)),
    (DAMAGE, "orphan 40", link(orphan=40)),
    ("link faults", "not read in time: 2 → run as", link(bus_unread=2)),
    ("link faults", "lost 1 → check the adapter", link(100, lost=1)),
    ("link faults", "silences 1", link(100, silences=1)),
    ("taxels noisy", "T5 of module 1 (hub 1, position 0), noise", noise(5, 500.0)),
    ("taxels noisy", "the whole module: T1, T2", noise(slice(12, 22), 500.0)),
    ("taxels noisy", "T9, T10 of module 4", noise(ALL_TAXELS[1:], 2500.0)),
    ("taxels at rest", "no taxel has a baseline → run once more", noise(ALL_TAXELS, 2500.0)),
    ("taxels noisy", "T5 of module 1 (hub 1, position 0), without a baseline", noise(5, 2500.0)),
    ("taxels dead", "T4 of module 3 (hub 1, position 2)", counts(fixed={(3, 4): 0})),
    ("taxels dead", "the whole module: T1", counts(fixed={(2, k): 0 for k in range(1, 11)})),
    ("taxels saturated", "T1 of module 4", counts(fixed={(4, 1): 43_000})),
    ("taxels stuck", "T10 of module 4", counts(fixed={(4, 10): 10_123})),
    ("temperature 0, or 43000 and more", "T0 of module 2 (hub 1", counts(fixed={(2, 0): 0})),
    ("temperature jumps within a second", "T0 of module 1 (hub 1, position 0): ", jumping_t0),
    ("press answers", "; modules 2 and 4 are swapped →", presses(1, 4, 3, 2)),
    ("press answers", "module 2 answered for 1; module 3 answered", presses(2, 3, 1, 4)),
    ("press answers", "module 3 (hub 1, position 2) felt nothing", presses(1, 2, None, 4)),
    ("press strength", "modules 1, 2, 3, 4 felt 900 at", presses(1, 2, 3, 4, peak=900.0)),
]


@pytest.mark.parametrize(("broken", "says", "make"), FAULTS)
def test_a_fault_breaks_its_own_rule_alone_and_is_named(broken: str, says: str, make: Make) -> None:
    found = failed(make())
    assert list(found) == broken.split("|")
    assert says in next(iter(found.values()))


def drifting() -> Received:
    return received(
        [
            replace(scan, counts=tuple(value + i // 20 for value in scan.counts))
            for i, scan in enumerate(scans_of())
        ]
    )


def declared_twice() -> Received:
    """A hub whose first table had a dead taxel."""
    dead = scans_of(times=TIMES[:100], fixed={(1, 1): 0})
    return received(dead + scans_of(times=TIMES[100:], version=2))


def of_two_hubs() -> Received:
    """The second hub's first scan comes after that of the first."""
    first = scans_of((A, B), TIMES[:40])
    second = [replace(scan, ihb=2) for scan in scans_of((C, D), TIMES[:40] + 0.01)]
    scans = [scan for pair in zip(first, second, strict=True) for scan in pair]
    return received(scans, tables={1: (A, B), 2: (C, D)}, span=(SPAN[0], TIMES[40]))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (of_two_hubs, "40 of 40"),
        (presses(1, 2, 3, 4), "4 of 4 modules answered where they are"),
        (table(replace(A, mask=0xFFF, channels=12), B, C, D), "4 of 4 answered"),
        (counts(noise=0.2, fixed={(1, 3): 10_000}), "use --press"),
        (noise(slice(None), 0.5), "looks like a quiet one"),  # a flat patch
        (noise(slice(None), 130.0), "of 300 scans"),  # a large curved patch
        (drifting, "0 of 300 scans"),
        (declared_twice, "40 of 40"),
        (presses(1, 2, 3, 4, peak=31_000.0), "raise full_scale_counts"),
    ],
)
def test_what_is_no_fault_breaks_no_rule(make: Make, says: str) -> None:
    got = make()
    assert failed(got) == {}
    assert says in " ".join(rule.measured for rule in checks.rules(got))


def test_scans_lost_to_damaged_packets_break_the_links_rule_and_not_the_rates() -> None:
    torn = [
        replace(scan, counts=(*scan.counts[:40], *[MISSING] * 4)) if i % 20 == 10 else scan
        for i, scan in enumerate(scans_of())
    ]
    got = received(torn, link=LINK + Counter(crc_errors=15))
    assert list(failed(got)) == [DAMAGE]
    assert "15 of 300 scans" in [rule.measured for rule in checks.rules(got)]


def test_what_cannot_be_checked_has_not_passed() -> None:
    first, *others = checks.rules(silent({})())
    assert first.holds is False
    assert {rule.holds for rule in others} == {None}


@pytest.mark.parametrize("n", [1, 2, 3, 19, 21])
def test_with_few_scans_no_rule_breaks_but_the_rates(n: int) -> None:
    got = received(scans_of(times=TIMES[:n]), span=(1000.0, 1000.0))
    assert all(name.startswith("rate") for name in failed(got))


RELEASED = (0,) * 8


@pytest.mark.parametrize(
    ("over", "free", "peak"),
    [
        ((0, 0, 60, 300, 200, *RELEASED, 900, 900), True, 300.0),
        ((60, 300, 200), True, 300.0),
        ((0, 400, 0, 0, 400, 0), True, None),
        ((400,) * 20, False, None),
        ((*(400,) * 20, *RELEASED, 70, 80, *RELEASED), False, 80.0),
    ],
)
def test_a_press_begins_on_a_free_skin_and_ends_with_its_release(
    over: tuple[int, ...], free: bool, peak: float | None
) -> None:
    found = pressed(
        ((PERIOD_S * k, np.array([float(value)])) for k, value in enumerate(over)), free=free
    )
    assert (None if found is None else float(found[0])) == peak


def test_the_json_is_strict_and_has_a_row_for_each_rule_and_taxel() -> None:
    got = table(A, B, C)()
    found = checks.rules(got)
    text = json.dumps(accept.report("can:can0", "now", got, found))
    value = json.loads(text, parse_constant=pytest.fail)
    assert [row["holds"] for row in value["rules"]] == [rule.holds for rule in found]
    assert len(value["taxels"]) == len(SKIN)
    assert (value["taxels"][-1]["level"], value["passed"]) == (None, False)
