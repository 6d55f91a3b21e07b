"""Maps of a hub's channels: to the layout's taxels, and to the modules' temperatures."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Index
from taxeld.layout.layout import Layout
from taxeld_protocol.decoder import Scan
from taxeld_protocol.modules import ABSENT_UID

NAMED = 8  # modules that one message names at most
TEMPERATURE = 0  # name of the temperature channel, in the low nibble of its UID


class Wired(NamedTuple):
    """A hub's channels by their use."""

    channels: Index  # channels of taxels
    taxels: Index  # taxels of these channels, in the same order
    places: Index | slice  # `taxels`, as a slice where the hub has the whole skin
    t0_channels: Index  # channels of temperatures
    t0_modules: Index  # modules of these channels, in the same order


class Wiring:
    """The maps of all hubs, made anew when a hub's module table changes."""

    def __init__(self, layout: Layout) -> None:
        suis, module = np.unique(layout.uid >> 4, return_inverse=True)
        self.suis: list[int] = suis.tolist()  # serial number of each module
        self.module: Index = module.astype(np.intp)  # (M,) module of each taxel
        self._taxel = {int(uid): i for i, uid in enumerate(layout.uid)}
        # A taxel of an array may have the name of a temperature; then the layout says that it is
        # a taxel.
        self._t0 = {
            sui << 4 | TEMPERATURE: m
            for m, sui in enumerate(self.suis)
            if sui << 4 | TEMPERATURE not in self._taxel
        }
        self._maps: dict[int, tuple[int, Wired]] = {}
        self.hubs: dict[int, list[int]] = {}  # hub → serial numbers of its modules
        self.lacking: tuple[int, ...] = tuple(self.suis)  # modules on no hub
        self.foreign: tuple[int, ...] = ()  # modules that hubs declared and the layout lacks
        self._suis = set(self.suis)
        self.neighbours: set[int] = set()  # modules of other links, which are not foreign

    def of(self, scan: Scan) -> Wired:
        """The map for this scan's module table."""
        version, wired = self._maps.get(scan.ihb, (None, None))
        if wired is None or version != scan.table_version:
            uids = [uid for module in scan.table for uid in module.uids]
            channels, taxels = _pairs(uids, self._taxel)
            is_all = np.array_equal(taxels, np.arange(len(self._taxel)))
            places = slice(None) if is_all else taxels
            wired = Wired(channels, taxels, places, *_pairs(uids, self._t0))
            self._maps[scan.ihb] = scan.table_version, wired
            self._note(scan.ihb, {uid >> 4 for uid in uids if self._is_taxel(uid)})
        return wired

    def _is_taxel(self, uid: int) -> bool:
        return uid != ABSENT_UID and (uid & 0xF != TEMPERATURE or uid in self._taxel)

    def _note(self, hub: int, suis: set[int]) -> None:
        """Record a hub's modules with taxels. A module that has gone since is not lacking: its
        taxels are dead."""
        self.hubs[hub] = sorted(suis)
        self.lacking = tuple(sui for sui in self.lacking if sui not in suis)
        self.foreign = tuple(sorted({*self.foreign, *suis} - self._suis - self.neighbours))


def _pairs(uids: list[int], index: dict[int, int]) -> tuple[Index, Index]:
    """Channels whose UIDs are in the index, and the index's numbers for them."""
    pairs = [(channel, index[uid]) for channel, uid in enumerate(uids) if uid in index]
    pairs.sort(key=lambda pair: pair[1])
    channels, found = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return channels, found


def mismatch(lacking: Sequence[int], of_layout: int, foreign: int, match: bool) -> str:
    """How the hubs' modules differ from the layout's, with the cure; empty where they agree."""
    parts = []
    if lacking:
        named = ", ".join(map(str, lacking[:NAMED])) + (", …" if len(lacking) > NAMED else "")
        parts.append(f"{len(lacking)} of its {of_layout} modules are on no hub (SUI {named})")
    if foreign:
        parts.append(f"the hubs have {foreign} modules that are not in it")
    if not parts:
        return ""
    cure = "; is it the layout of this skin?"
    if not match:
        cure = "; estimates are not valid: give the layout of this skin, or see to its modules"
    return " and ".join(parts) + cure
