"""What a recording has of a link's skin: at rest, then pressed, module by module in any order.

The rules are functions of `RecordedSkin` alone.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from taxeld.arrays import Floats
from taxeld.skin.skin import Skin
from taxeld_protocol.array import ArrayDecoder
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.modules import Module

T0_S = 1.0  # between two looks at the temperatures
PRESS_SCANS = 2  # scans in a row: a single one may be a disturbance


class RecordedSkin:
    """A skin of M taxels on K modules, as the daemon's own skin stage reads its scans."""

    def __init__(self, skin: Skin, period_ms: int) -> None:
        """`period_ms`: of the scans that the hub was asked for."""
        m = len(skin.layout)
        self.skin, self.layout, self.period_ms = skin, skin.layout, period_ms
        self.tables: dict[int, Sequence[Module]] = {}  # modules of each hub that sent scans
        self.silent: list[int] = []  # hubs that declared modules, and sent no scan of them
        self.refusal = ""  # a line on a hub, or an array, that cannot be read; or empty
        self.link = Counter[str]()  # the decoder's, by their names in the daemon's health
        self.times: dict[int, list[float]] = {}  # of each hub's whole scans
        self.begun_t, self.end_t = np.inf, 0.0  # of the scans, and of the recording
        self.came, self.unread, self.over = np.zeros((3, m))  # each taxel's scans at rest
        self.t0: list[Floats] = []  # (K,) each module's temperature at rest, every T0_S
        self.rest_s: float | None = None  # until the first press; None: there was none
        self.led: dict[int, float] = {}  # module (SUI) that read most of a press → when first
        self.peak = np.zeros(m)  # most counts over the idle level
        self._touched = 0  # scans in a row

    def take(self, scan: Scan) -> None:
        """Take the next scan."""
        self.tables[scan.ihb] = scan.table
        if not scan.complete:
            return
        self.times.setdefault(scan.ihb, []).append(scan.t)
        self.begun_t = min(self.begun_t, scan.t)
        activation = self.skin.on_scan(scan)
        if self.rest_s is None:
            self._rest(scan)
        touched = activation is not None and self.skin.touched
        self._touched = self._touched + 1 if touched else 0
        if activation is not None and self._touched >= PRESS_SCANS:
            if self.rest_s is None:
                self.rest_s = scan.t - self.begun_t
            over = np.where(activation.z > 0.0, self.skin.over, 0.0)
            self.peak = np.maximum(self.peak, over)
            most = np.bincount(self.skin.wiring.module, over).argmax()
            self.led.setdefault(self.skin.wiring.suis[most], scan.t)

    def _rest(self, scan: Scan) -> None:
        skin, own = self.skin, self.skin.wiring.of(scan).taxels
        self.came[own] += 1.0
        self.unread[own] += skin.counts[own] == 0.0
        self.over[own] += np.isin(own, skin.faults()["saturated_taxels"])
        state = skin.state() if scan.t >= self.begun_t + T0_S * len(self.t0) else None
        if state is not None:
            self.t0.append(state.t0)

    def end(self, t: float, decoder: Decoder | ArrayDecoder) -> None:
        """The recording has ended at a Unix time; `decoder`: of its source."""
        stats: dict[str, Any] = decoder.stats()
        self.end_t, self.link = t, Counter(stats | stats.pop("dropped"))
        if isinstance(decoder, ArrayDecoder):
            self.refusal = decoder.fault
        else:
            sent = {m.sui for table in self.tables.values() for m in table}
            # a hub that was given another short id has declared itself under both
            tables = decoder.tables.items()
            self.silent = [ihb for ihb, table in tables if not sent & {m.sui for m in table}]
            self.refusal = decoder.refusal

    def module(self, sui: int) -> str:
        """A module's serial number, and where on which hub it is."""
        for hub, table in self.tables.items():
            for position, module in enumerate(table):
                if module.sui == sui:
                    return f"module {sui} (hub {hub}, position {position})"
        return f"module {sui} (no hub)"
