"""Scans and counters of an untouched skin, after the daemon's own bring-up.

The checks are functions of `Received` alone: they need no device and no clock.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout
from taxeld.source.bring_up import SILENCE_S
from taxeld.source.sources import Source
from taxeld_hil.acceptance.idle import IdleReadings, measured
from taxeld_protocol.array import ArrayDecoder
from taxeld_protocol.decoder import Scan
from taxeld_protocol.modules import Module

POLL_S = 0.001
ANSWER_S = 10.0  # a hub that was just powered needs seconds
# Counters of damaged packets.
DAMAGES = ("crc_errors", "length_errors", "index_errors", "malformed", "noise")

Say = Callable[[str], None]  # prints a line to the operator


class Press(NamedTuple):
    """One module that the operator was asked to press; modules by their serial numbers (SUI)."""

    asked: int
    answered: int | None  # the module that was pressed most; None: none in time
    peak: Floats  # (M,) most counts over the idle level


@dataclass(frozen=True)
class Received:
    """One acceptance run; counters are the source's, under their names in the daemon's health."""

    layout: Layout
    period_ms: int  # period of scans that the hub was asked for
    full_scale_counts: float
    tables: Mapping[int, Sequence[Module]]  # short id of each hub that declared itself → modules
    bring_up: Counter[str]  # counts before the idle period
    link: Counter[str]  # counts in the idle period
    scans: Sequence[Scan]  # scans in the idle period
    span: tuple[float, float]  # begin and end of the idle period, in the clock of the scans
    presses: Sequence[Press] | None = None  # None: not asked for
    firmware: Mapping[str, str] = field(default_factory=dict)  # short id → versions, in words

    @cached_property
    def idle(self) -> IdleReadings:
        """Readings of each taxel in the idle period."""
        return measured(self.layout, self.scans, self.period_ms / 1e3, self.full_scale_counts)

    @property
    def times(self) -> dict[int, Floats]:
        """Times (n,) [s] of the complete scans of each hub."""
        hubs = sorted({scan.ihb for scan in self.scans})
        return {h: np.array([s.t for s in self.scans if s.ihb == h and s.complete]) for h in hubs}

    @property
    def damaged(self) -> int:
        """Packets of the idle period that came and could not be used."""
        return sum(self.link[kind] for kind in DAMAGES)

    @property
    def peak(self) -> Floats | None:
        """(M,) most counts over idle in any press; None without presses."""
        return np.max([p.peak for p in self.presses], axis=0) if self.presses else None

    def module(self, sui: int) -> str:
        """A module's serial number, and where on which hub it is."""
        for hub, table in self.tables.items():
            for position, module in enumerate(table):
                if module.sui == sui:
                    return f"module {sui} (hub {hub}, position {position})"
        return f"module {sui} (no hub)"


def receive(
    source: Source, layout: Layout, say: Say, seconds: float, period_ms: int, full_scale: float
) -> Received:
    """Bring up the skin behind an open source, and listen to it for so many seconds."""
    began = _counters(source)
    say("looking for hubs")
    if any(True for _ in scans(source, ANSWER_S)):
        for _ in scans(source, SILENCE_S):  # other hubs may be slower
            pass
        say(f"listening for {seconds:g} s: leave the skin untouched")
    else:
        seconds = 0.0
    before, start = _counters(source), time.time()
    came = list(scans(source, seconds))
    bring_up, link = _since(began, before), _since(before, _counters(source))
    tables = _tables(source, {scan.ihb for scan in came})
    span = start, time.time()
    heard = layout, period_ms, full_scale, tables, bring_up, link, came, span
    return Received(*heard, firmware=source.firmware)


def scans(source: Source, seconds: float) -> Iterator[Scan]:
    """The scans that come within so many seconds."""
    end = time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        yield from source.poll(now)
        time.sleep(POLL_S)


def _counters(source: Source) -> Counter[str]:
    stats = source.decoder.stats()
    dropped = stats["dropped"]
    assert isinstance(dropped, dict)  # noqa: S101  (of CySkin's decoder)
    bus = {f"bus_{fault}": times for fault, times in source.bus.counts.items()}
    found = {**stats, **dropped, **asdict(source.counters), **bus}
    return Counter({name: value for name, value in found.items() if isinstance(value, int)})


def _since(before: Counter[str], after: Counter[str]) -> Counter[str]:
    return Counter({name: count - before[name] for name, count in after.items()})


def _tables(source: Source, ids: set[int]) -> dict[int, Sequence[Module]]:
    """The hubs' tables by short id. A hub that was given another short id has declared itself
    under both: then the one that is among the `ids` of scans."""
    decoder = source.decoder
    if isinstance(decoder, ArrayDecoder):
        return dict.fromkeys(ids, decoder.table)
    hubs: dict[tuple[Module, ...], int] = {}
    for ihb, hub in decoder.hubs.items():
        modules = tuple(hub.table.modules)
        if modules and (modules not in hubs or ihb in ids):
            hubs[modules] = ihb
    return {ihb: modules for modules, ihb in hubs.items()}
