"""Which channel of a hub's scan is which taxel of the layout, and which a module's temperature."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Index
from taxeld.layout.layout import Layout
from taxeld_protocol.decoder import Scan
from taxeld_protocol.modules import ABSENT_UID

NAMED = 8  # modules at most, in a line
TEMPERATURE = 0  # name of the temperature channel, the low nibble of its UID


class Wired(NamedTuple):
    """A hub's channels by what they read."""

    channels: Index  # that are taxels,
    taxels: Index  # which, in their order
    places: Index | slice  # the same, shorter where they are all that the skin has
    t0_channels: Index  # that are temperatures,
    t0_modules: Index  # of which modules


class Wiring:
    """The maps of all hubs, made anew when a hub's module table changes."""

    def __init__(self, layout: Layout) -> None:
        suis, module = np.unique(layout.uid >> 4, return_inverse=True)
        self.suis: list[int] = suis.tolist()  # of each module
        self.module: Index = module.astype(np.intp)  # (M,) of each taxel
        self._taxel = {int(uid): i for i, uid in enumerate(layout.uid)}
        # an iCub taxel may have the name of a temperature; what the layout has is a taxel
        self._t0 = {
            sui << 4 | TEMPERATURE: m
            for m, sui in enumerate(self.suis)
            if sui << 4 | TEMPERATURE not in self._taxel
        }
        self._maps: dict[int, tuple[int, Wired]] = {}
        self.hubs: dict[int, list[int]] = {}  # of each the modules that it told of last
        self.lacking: tuple[int, ...] = tuple(self.suis)  # modules of the layout never told of,
        self.foreign: tuple[int, ...] = ()  # and of hubs, that the layout has not
        self._suis = set(self.suis)

    def of(self, scan: Scan) -> Wired:
        version, wired = self._maps.get(scan.ihb, (None, None))
        if wired is None or version != scan.table_version:
            uids = [uid for module in scan.table for uid in module.uids]
            channels, taxels = _pairs(uids, self._taxel)
            is_all = np.array_equal(taxels, np.arange(len(self._taxel)))
            places = slice(None) if is_all else taxels
            wired = Wired(channels, taxels, places, *_pairs(uids, self._t0))
            self._maps[scan.ihb] = scan.table_version, wired
            self._note(scan.ihb, {uid >> 4 for uid in uids if uid & 0xF and uid != ABSENT_UID})
        return wired

    def _note(self, hub: int, suis: set[int]) -> None:
        """Modules with taxels. One that has gone since is not lacking: its taxels are dead."""
        self.hubs[hub] = sorted(suis)
        self.lacking = tuple(sui for sui in self.lacking if sui not in suis)
        self.foreign = tuple(sorted({*self.foreign, *suis} - self._suis))


def _pairs(uids: list[int], index: dict[int, int]) -> tuple[Index, Index]:
    """Channels whose UIDs are in the index, and what they are there."""
    pairs = [(channel, index[uid]) for channel, uid in enumerate(uids) if uid in index]
    pairs.sort(key=lambda pair: pair[1])
    channels, found = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return channels, found


def mismatch(lacking: Sequence[int], of_layout: int, foreign: int, match: bool) -> str:
    """How the hubs' modules differ from the layout's, with the cure; empty where they do not."""
    parts = []
    if lacking:
        named = ", ".join(map(str, lacking[:NAMED])) + (", …" if len(lacking) > NAMED else "")
        parts.append(f"{len(lacking)} of its {of_layout} modules are on no hub (SUI {named})")
    if foreign:
        parts.append(f"the hubs have {foreign} modules that it has not")
    if not parts:
        return ""
    cure = "; is it the layout of this skin?"
    if not match:
        cure = "; estimates are not valid: give the layout of this skin, or see to its modules"
    return " and ".join(parts) + cure
