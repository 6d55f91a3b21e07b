"""Presses by hand: one on each module that is named, and which module felt it."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout
from taxeld.skin.skin import Skin
from taxeld.source.sources import Source
from taxeld_hil.acceptance.received import Press, Received, Say, scans

PRESS_S = 20.0  # time to find a module and press it
TRIES = 2  # a press may miss its module
PRESS_SCANS = 2  # scans in a row: a single one may be a disturbance
RELEASED_S = 0.3  # the skin is free for so long after a press


def pressed_by_hand(source: Source, got: Received, say: Say) -> Received:
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
                    peak = pressed(_followed(source, skin), free=not skin.touched)
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


def _followed(source: Source, skin: Skin) -> Iterator[tuple[float, Floats]]:
    """Times of the scans for a press, and counts (M,) over the idle level where it is felt."""
    for scan in scans(source, PRESS_S):
        if (activation := skin.on_scan(scan)) is not None:
            yield scan.t, np.where(activation.z > 0.0, skin.over, 0.0)


def _place(layout: Layout, sui: int) -> str:
    """A module, and in words where the layout has it."""
    x, y, z = layout.position_m[layout.uid >> 4 == sui].mean(axis=0)
    if math.isinf(layout.radius_m):
        return f"module {sui} (x {1e3 * x:.0f} mm, y {1e3 * y:.0f} mm)"
    turn = math.degrees(math.atan2(y, x)) % 360
    return f"module {sui} ({turn:.0f}° about the axis, z {1e3 * z:.0f} mm)"
