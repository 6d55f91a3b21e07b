"""Presses by hand: one on each module that is named, and which module felt it."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.layout.layout import Layout
from taxeld.skin.channels import Wiring
from taxeld.source.sources import Source
from taxeld_hil.acceptance.received import Press, Received, Say, scans
from taxeld_protocol.decoder import MISSING

PRESS_S = 20.0  # time to find a module and press it
TRIES = 2  # a press may miss its module
PRESS_SCANS = 2  # scans in a row: a single one may be a disturbance
RELEASED_S = 0.3  # the skin is free for so long after a press


def ask(source: Source, received: Received, say: Say) -> list[Press]:
    """A press on every module that has a usable taxel; Ctrl-C ends them early, and those that are
    left are not answered."""
    idle, wiring = received.idle, Wiring(received.layout)
    usable, serial = idle.usable & ~idle.noisy, received.layout.uid >> 4
    modules = np.unique(serial[usable]).tolist()
    if not modules:
        return []
    say(f"press {len(modules)} modules with a finger, one after the other; Ctrl-C ends")
    level = np.where(usable, idle.level, np.inf)  # an unusable taxel is never pressed
    over: Floats = np.zeros(len(level))
    found = {asked: Press(asked, None, np.zeros(len(level))) for asked in modules}
    try:
        for number, asked in enumerate(modules, 1):
            where = f"module {asked} ({_place(received.layout, serial == asked)})"
            for _ in range(TRIES):
                say(f"{number}/{len(modules)} press {where}")
                free = not (over > idle.threshold).any()
                peak = pressed(_follow(source, wiring, level, over), idle.threshold, free=free)
                if peak is None:
                    say("  nothing was felt")
                    break
                felt = np.where(peak > idle.threshold, peak, 0.0)
                answered = max(modules, key=lambda sui: float(felt[serial == sui].sum()))
                found[asked] = Press(asked, answered, peak)
                say(f"  module {answered} answered, {peak.max():.0f} counts")
                if answered == asked:
                    break
    except KeyboardInterrupt:
        say("  ended early")
    return list(found.values())


def pressed(
    readings: Iterable[tuple[float, Floats]], threshold: Floats, *, free: bool
) -> Floats | None:
    """The most counts (M,) that a press reads; None where none begins.

    A press begins when a skin that was free is touched, and ends when it is free again.
    `readings`: times [s] and counts over the idle level (M,); `threshold`: counts (M,) that are a
    touch; `free`: whether nothing is touched at first."""
    peak, last_s, scans_over = None, -math.inf, 0
    for t, over in readings:
        if not (over > threshold).any():
            scans_over, free = 0, free or t - last_s > RELEASED_S
            if peak is not None and free:
                break
            continue
        last_s, scans_over = t, scans_over + 1
        if free and scans_over >= PRESS_SCANS:
            peak, free = np.zeros(len(over)), False
        if peak is not None:
            peak = np.maximum(peak, over)
    return peak


def _follow(
    source: Source, wiring: Wiring, level: Floats, over: Floats
) -> Iterator[tuple[float, Floats]]:
    """Times of scans for a press, and `over` (M,), the newest counts over `level` (M,)."""
    for scan in scans(source, PRESS_S):
        wired = wiring.of(scan)
        channels = wired.channels[: len(wired.taxels)]
        counts = np.array(scan.counts, dtype=np.float64)[channels]
        came = counts != MISSING
        over[wired.taxels[came]] = np.maximum(counts - level[wired.taxels], 0.0)[came]
        yield scan.t, over


def _place(layout: Layout, own: Bools) -> str:
    """Place of some taxels (M,) in words, as the layout has them."""
    x, y, z = layout.position_m[own].mean(axis=0)
    if math.isinf(layout.radius_m):
        return f"x {1e3 * x:.0f} mm, y {1e3 * y:.0f} mm"
    return f"{math.degrees(math.atan2(y, x)) % 360:.0f}° about the axis, z {1e3 * z:.0f} mm"
