"""Which channel of a hub is which taxel of the layout, or the temperature of which module."""

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
    """The channels of a hub that the skin uses."""

    channels: Index  # (n,)
    places: Index | slice  # (n,) ascending: a channel's taxel, or M + the module of a temperature
    taxels: Index  # the places that are taxels: the first ones


class Wiring:
    """The maps of all hubs, made anew when a hub's module table changes."""

    def __init__(self, layout: Layout) -> None:
        suis, module = np.unique(layout.uid >> 4, return_inverse=True)
        self.suis: list[int] = suis.tolist()  # serial number of each module
        self.module: Index = module.astype(np.intp)  # (M,) module of each taxel
        self._taxels = len(layout)
        # A taxel of an array may have the name of a temperature: the layout decides.
        self._place = {sui << 4 | TEMPERATURE: len(layout) + m for m, sui in enumerate(self.suis)}
        self._place |= {uid: taxel for taxel, uid in enumerate(layout.uid.tolist())}
        self._maps: dict[int, tuple[int, Wired]] = {}
        self.hubs: dict[int, list[int]] = {}  # hub → serial numbers of its modules
        # modules that no hub has had: one that has gone since has dead taxels
        self.lacking: tuple[int, ...] = tuple(self.suis)
        self.foreign: tuple[int, ...] = ()  # modules that hubs declared and the layout lacks
        self.neighbours: set[int] = set()  # modules of other links, which are not foreign

    def of(self, scan: Scan) -> Wired:
        """The map for this scan's module table."""
        version, wired = self._maps.get(scan.ihb, (None, None))
        if wired is None or version != scan.table_version:
            uids = [uid for module in scan.table for uid in module.uids]
            pairs = sorted(
                (self._place[uid], k) for k, uid in enumerate(uids) if uid in self._place
            )
            places, channels = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
            wired = Wired(channels, _run(places), places[places < self._taxels])
            self._maps[scan.ihb] = scan.table_version, wired
            suis = {uid >> 4 for uid in uids if self._is_taxel(uid)}
            self.hubs[scan.ihb] = sorted(suis)
            self.lacking = tuple(sui for sui in self.lacking if sui not in suis)
            foreign = {*self.foreign, *suis} - {*self.suis} - self.neighbours
            self.foreign = tuple(sorted(foreign))
        return wired

    def _is_taxel(self, uid: int) -> bool:
        is_named = uid & 0xF != TEMPERATURE or self._place.get(uid, self._taxels) < self._taxels
        return uid != ABSENT_UID and is_named


def _run(places: Index) -> Index | slice:
    """A slice, with which numpy is faster, where no place is left out."""
    if not len(places) or (np.diff(places) != 1).any():
        return places
    return slice(int(places[0]), int(places[-1]) + 1)


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
