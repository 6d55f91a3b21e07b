"""The links that are on one source."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld_protocol.decoder import Scan


class LinkTable:
    """The links whose taxels are in the scans of a source."""

    def __init__(self, skins: Mapping[int, Layout]) -> None:
        """`skins`: the layout of each link, by the link's number."""
        self.numbers = tuple(skins)
        self._uids = {k: set(layout.uid.tolist()) for k, layout in skins.items()}
        self._of: dict[int, tuple[int, tuple[int, ...]]] = {}  # hub → table's version, links

    def of(self, scans: Iterable[Scan]) -> list[Scan]:
        """The scans with the number of their link, each once for every link that it is of."""
        return [
            replace(scan, link=number) if number else scan
            for scan in scans
            for number in self._links(scan)
        ]

    def _links(self, scan: Scan) -> tuple[int, ...]:
        """The links of a scan; the first where it has no taxel of any."""
        if len(self.numbers) == 1:
            return self.numbers
        version, found = self._of.get(scan.ihb, (None, ()))
        if version != scan.table_version:
            uids = {uid for module in scan.table for uid in module.uids}
            found = tuple(k for k, own in self._uids.items() if uids & own) or self.numbers[:1]
            self._of[scan.ihb] = scan.table_version, found
        return found


def joint(layouts: Sequence[Layout]) -> Layout:
    """What one source has of several layouts: their taxels, on no common cylinder."""
    if len(layouts) == 1:
        return layouts[0]
    uid, position, normal = (
        np.concatenate([getattr(each, name) for each in layouts])
        for name in ("uid", "position_m", "normal")
    )
    return Layout(" + ".join(each.name for each in layouts), uid, position, normal, math.inf)


def check_uids(names: Sequence[str], layouts: Sequence[Layout]) -> None:
    """Raises SetupError where two layouts of one source have the same taxels."""
    pairs = zip(names, layouts, strict=True)
    for (name, one), (again, two) in combinations(pairs, 2):
        common = set(one.uid.tolist()) & set(two.uid.tolist())
        if common:
            sui = min(common) >> 4
            raise SetupError(
                f"skin.layout: {name} and {again} are on one bus, and both have module {sui}; "
                "give each link its own modules, or its own [skin.source]"
            )
