"""Scans and counters of an untouched skin, after the daemon's own bring-up; and presses by hand.

The rules are functions of `Received` alone: they need no device and no clock.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model.noise import FLOOR
from taxeld.service.inputs import Inputs
from taxeld.skin.rest import NOISE_MAX
from taxeld.skin.skin import Skin
from taxeld.source.bring_up import SILENCE_S
from taxeld.source.sources import Source
from taxeld_protocol.array import ArrayDecoder
from taxeld_protocol.decoder import Scan
from taxeld_protocol.modules import Module

POLL_S = 0.001
ANSWER_S = 10.0  # a hub that was just powered needs seconds
T0_S = 1.0  # between two looks at the temperatures
INVALID = 0.01  # share of the scans
PRESS_S = 20.0  # time to find a module and press it
TRIES = 2  # a press may miss its module
PRESS_SCANS = 2  # scans in a row: a single one may be a disturbance
RELEASED_S = 0.3  # the skin is free for so long after a press
STANDS_OUT = 10.0  # times the skin's median noise; 23..59 counts is what 80 % of a skin lie in

Say = Callable[[str], None]  # prints a line to the operator


class Press(NamedTuple):
    """One module that the operator was asked to press; modules by their serial numbers (SUI)."""

    asked: int
    answered: int | None  # the module that was pressed most; None: none in time
    peak: Floats  # (M,) most counts over the idle level


class Untouched(NamedTuple):
    """M taxels on K modules that nothing touches, as the daemon's own skin stage reads them."""

    skin: Skin
    level: Floats  # (M,) counts; nan where none is known
    noise: Floats  # (M,) sd of a reading [counts]
    t0: Floats  # (n, K) each module's temperature every T0_S, nan where it is not known
    fine: Bools  # (M,) taxels that a hub has, and that are neither saturated, dead nor stuck
    faults: Mapping[str, Bools]  # fault → taxels (M,); a taxel has one fault at most


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
    def untouched(self) -> Untouched | None:
        """The skin at rest, by the whole scans since each hub's last module table; None where they
        are too few for a baseline. Taxels that no hub has are without a fault."""
        config = SkinConfig(full_scale_counts=self.full_scale_counts)
        skin, m = Skin(self.layout, config, silent_s=np.inf), len(self.layout)
        last = {scan.ihb: scan.table_version for scan in self.scans}
        scans = [s for s in self.scans if s.complete and s.table_version == last[s.ihb]]
        came, unread, over, t0, next_t = np.zeros(m), np.zeros(m), np.zeros(m), [], 0.0
        for scan in scans:
            skin.on_scan(scan)
            own, found = skin.wiring.of(scan).taxels, skin.faults()
            came[own] += 1.0
            unread[own] += skin.counts[own] == 0.0
            over[own] += np.isin(own, found["saturated_taxels"])
            if scan.t >= next_t and (state := skin.state()) is not None:
                t0.append(state.t0)
                next_t = scan.t + T0_S
        if (state := skin.state()) is None:
            return None
        t0.append(state.t0)
        heard, often, is_stuck = came > 0.0, INVALID * came, np.zeros(m, dtype=bool)
        is_stuck[found["stuck_taxels"]] = True
        faults = {
            "saturated": over > often,
            "dead": (over <= often) & (unread - over > often),
            "stuck": is_stuck,
        }
        fine, unknown = heard & ~np.any([*faults.values()], axis=0), np.isnan(state.baseline)
        noise, usual = np.where(unknown, np.nan, state.noise), state.noise[fine & ~unknown]
        # noise under which the daemon's threshold is the same for all taxels does not matter
        limit = FLOOR * self.full_scale_counts / config.threshold_sigmas
        limit = max(limit, STANDS_OUT * float(np.median(usual)) if len(usual) else 0.0)
        limit = min(limit, NOISE_MAX * self.full_scale_counts)
        faults["noisy"] = fine & (unknown | (noise > limit))
        return Untouched(skin, state.baseline, noise, np.array(t0), fine, faults)

    def module(self, sui: int) -> str:
        """A module's serial number, and where on which hub it is."""
        for hub, table in self.tables.items():
            for position, module in enumerate(table):
                if module.sui == sui:
                    return f"module {sui} (hub {hub}, position {position})"
        return f"module {sui} (no hub)"


def receive(
    inputs: Inputs, layout: Layout, say: Say, seconds: float, period_ms: int, full_scale: float
) -> Received:
    """Bring up the skin behind an open source, and listen to it for so many seconds."""
    (source,) = inputs.sources
    began = _counters(source)
    say("looking for hubs")
    if any(True for _ in scans(inputs, ANSWER_S)):
        for _ in scans(inputs, SILENCE_S):  # other hubs may be slower
            pass
        say(f"listening for {seconds:g} s: leave the skin untouched")
    else:
        seconds = 0.0
    before, start = _counters(source), time.time()
    came = list(scans(inputs, seconds))
    return Received(
        layout,
        period_ms,
        full_scale,
        tables=_tables(source, {scan.ihb for scan in came}),
        bring_up=before - began,
        link=_counters(source) - before,
        scans=came,
        span=(start, time.time()),
        firmware=source.firmware,
    )


def scans(inputs: Inputs, seconds: float) -> Iterator[Scan]:
    """The scans that come within so many seconds."""
    end = time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        yield from inputs.poll(now)
        time.sleep(POLL_S)


def _counters(source: Source) -> Counter[str]:
    stats = source.decoder.stats()
    dropped = stats["dropped"]
    assert isinstance(dropped, dict)  # noqa: S101  (of CySkin's decoder)
    bus = {f"bus_{fault}": times for fault, times in source.bus.counts.items()}
    found = {**stats, **dropped, **asdict(source.counters), **bus}
    return Counter({name: value for name, value in found.items() if isinstance(value, int)})


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


def pressed_by_hand(inputs: Inputs, got: Received, say: Say) -> Received:
    """The same with a press on every module that has a usable taxel; Ctrl-C ends them early, and
    those that are left are not answered."""
    found: dict[int, Press] = {}
    if got.untouched is not None:
        skin = got.untouched.skin
        usable = got.untouched.fine & ~got.untouched.faults["noisy"]
        modules = np.unique((got.layout.uid >> 4)[usable]).tolist()
        say(f"press {len(modules)} modules with a finger, one after the other; Ctrl-C ends")
        found = {asked: Press(asked, None, np.zeros(len(got.layout))) for asked in modules}
        try:
            for number, asked in enumerate(modules, 1):
                for _ in range(TRIES):
                    say(f"{number}/{len(modules)} press {_place(got.layout, asked)}")
                    peak = pressed(_followed(inputs, skin), free=not skin.touched)
                    if peak is None:
                        say("  nothing was felt")
                        break
                    by_module = np.bincount(skin.wiring.module, peak)
                    answered = skin.wiring.suis[int(by_module.argmax())]
                    found[asked] = Press(asked, answered, peak)
                    say(f"  module {answered} answered, {peak.max():.0f} counts")
                    if answered == asked:
                        break
        except KeyboardInterrupt:
            say("  ended early")
    return replace(got, presses=[*found.values()])


def pressed(readings: Iterable[tuple[float, Floats]], *, free: bool) -> Floats | None:
    """The most counts (M,) that a press reads; None where none begins.

    A press begins when a skin that was free is touched, and ends when it is free again.
    `readings`: times [s] and counts over the idle level (M,), 0 where nothing is touched;
    `free`: whether nothing is touched at first."""
    peak, last_s, touched = None, -math.inf, 0
    for t, over in readings:
        if not over.any():
            touched, free = 0, free or t - last_s > RELEASED_S
            if peak is not None and free:
                break
            continue
        last_s, touched = t, touched + 1
        if free and touched >= PRESS_SCANS:
            peak, free = np.zeros(len(over)), False
        if peak is not None:
            peak = np.maximum(peak, over)
    return peak


def _followed(inputs: Inputs, skin: Skin) -> Iterator[tuple[float, Floats]]:
    """Times of the scans for a press, and counts (M,) over the idle level where it is felt."""
    for scan in scans(inputs, PRESS_S):
        if (activation := skin.on_scan(scan)) is not None:
            yield scan.t, np.where(activation.z > 0.0, skin.over, 0.0)


def _place(layout: Layout, sui: int) -> str:
    """A module, and in words where the layout has it."""
    x, y, z = layout.position_m[layout.uid >> 4 == sui].mean(axis=0)
    if math.isinf(layout.radius_m):
        return f"module {sui} (x {1e3 * x:.0f} mm, y {1e3 * y:.0f} mm)"
    turn = math.degrees(math.atan2(y, x)) % 360
    return f"module {sui} ({turn:.0f}° about the axis, z {1e3 * z:.0f} mm)"
