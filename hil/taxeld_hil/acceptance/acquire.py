"""Acceptance on a device: bring the skin up as the daemon does, listen, and ask for presses."""

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.layout.layout import Layout
from taxeld.skin.channels import Wiring
from taxeld.source.bring_up import SILENCE_S
from taxeld.source.sources import Source
from taxeld_hil.acceptance.press import PressDetector, place
from taxeld_hil.acceptance.values import Link, Press, Received
from taxeld_protocol.decoder import MISSING, Decoder, Scan
from taxeld_protocol.modules import Module

POLL_S = 0.001
ANSWER_S = 10.0  # a hub that was just powered needs seconds
PRESS_S = 20.0  # to find a module and press it
TRIES = 2  # a press may miss its module

Say = Callable[[str], None]


class Acquisition:
    """One source that is read for a while."""

    def __init__(self, source: Source, layout: Layout, say: Say) -> None:
        """`say` prints a line to the operator."""
        self._source = source
        self._layout = layout
        self._say = say
        self._wiring = Wiring(layout)

    def receive(self, seconds: float, period_ms: int, full_scale_counts: float) -> Received:
        """Bring the skin up and listen to it, untouched, for so long."""
        began = Link.of(self._source)
        self._say("looking for hubs")
        if self._bring_up():
            self._say(f"listening for {seconds:g} s: leave the skin untouched")
        else:
            seconds = 0.0
        before, start = Link.of(self._source), time.time()
        scans = list(self._scans(seconds))
        return Received(
            layout=self._layout,
            period_ms=period_ms,
            full_scale_counts=full_scale_counts,
            tables=self._tables({scan.ihb for scan in scans}),
            bring_up=before.since(began),
            link=Link.of(self._source).since(before),
            scans=scans,
            span=(start, time.time()),
        )

    def presses(self, level: Floats, threshold: Floats, usable: Bools) -> list[Press]:
        """A press on every module that has a usable taxel; Ctrl-C ends them early."""
        modules = sorted(set(self._wiring.module[usable].tolist()))
        if not modules:
            return []
        self._say(f"press {len(modules)} modules with a finger, one after the other; Ctrl-C ends")
        detector = PressDetector(level, threshold, usable)
        found: list[Press] = []
        try:
            for number, asked in enumerate(modules, 1):
                where = f"module {self._wiring.suis[asked]} ({place(self._layout, asked)})"
                found.append(Press(asked, None, np.zeros(len(level))))
                for _ in range(TRIES):
                    self._say(f"{number}/{len(modules)} press {where}")
                    found[-1] = self._press(asked, detector)
                    if found[-1].answered in (asked, None):
                        break
        except KeyboardInterrupt:
            nothing = np.zeros(len(level))
            found += [Press(asked, None, nothing) for asked in modules[len(found) :]]
        return found

    def _press(self, asked: int, detector: PressDetector) -> Press:
        detector.begin()
        for scan in self._scans(PRESS_S):
            wired = self._wiring.of(scan)
            counts = np.array(scan.counts, dtype=np.float64)[wired.channels]
            detector.on_counts(scan.t, wired.taxels, np.where(counts == MISSING, np.nan, counts))
            if detector.done:
                break
        answered = detector.answer(self._wiring.module)
        if answered is None:
            self._say("  nothing was felt")
        else:
            self._say(
                f"  module {self._wiring.suis[answered]} answered, {detector.peak.max():.0f} counts"
            )
        return Press(asked, answered, detector.peak)

    def _bring_up(self) -> bool:
        """Wait for scans, and then for hubs that are slower; → whether any came."""
        if not any(True for _ in self._scans(ANSWER_S)):
            return False
        for _ in self._scans(SILENCE_S):
            pass
        return True

    def _scans(self, seconds: float) -> Iterator[Scan]:
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            yield from self._source.poll(now)
            time.sleep(POLL_S)

    def _tables(self, ids: set[int]) -> dict[int, Sequence[Module]]:
        """The hubs' tables by short id. A hub that was given another short id has declared itself
        under both: then the one that is among the `ids` of scans."""
        decoder = self._source.wire.decoder
        assert isinstance(decoder, Decoder)  # noqa: S101  (the CySkin dialect's)
        hubs: dict[tuple[Module, ...], int] = {}
        for ihb, hub in decoder.hubs.items():
            modules = tuple(hub.table.modules)
            if modules and (modules not in hubs or ihb in ids):
                hubs[modules] = ihb
        return {ihb: modules for modules, ihb in hubs.items()}
