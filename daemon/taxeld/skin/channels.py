"""Which channel of a hub's scan is which taxel of the layout, and which a module's temperature."""

from typing import NamedTuple

import numpy as np

from taxeld.arrays import Index
from taxeld.layout.layout import Layout
from taxeld_protocol.decoder import Scan

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

    def of(self, scan: Scan) -> Wired:
        version, wired = self._maps.get(scan.ihb, (None, None))
        if wired is None or version != scan.table_version:
            uids = [uid for module in scan.table for uid in module.uids]
            channels, taxels = _pairs(uids, self._taxel)
            is_all = np.array_equal(taxels, np.arange(len(self._taxel)))
            places = slice(None) if is_all else taxels
            wired = Wired(channels, taxels, places, *_pairs(uids, self._t0))
            self._maps[scan.ihb] = scan.table_version, wired
        return wired


def _pairs(uids: list[int], index: dict[int, int]) -> tuple[Index, Index]:
    """Channels whose UIDs are in the index, and what they are there."""
    pairs = [(channel, index[uid]) for channel, uid in enumerate(uids) if uid in index]
    pairs.sort(key=lambda pair: pair[1])
    channels, found = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return channels, found
