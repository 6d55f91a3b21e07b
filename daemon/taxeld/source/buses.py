"""The buses of a configuration: sources, and the links whose taxels the scans of each hold."""

import math
from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np

from taxeld.config.tables import Config, SourceConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.source.source import Source
from taxeld_protocol.decoder import Scan


class Bus:
    """A source, and the links whose taxels its scans hold."""

    def __init__(self, source: Source, links: Sequence[int], layouts: Sequence[Layout]) -> None:
        """`links`: their numbers, `layouts` in the same order."""
        self.source = source
        self.links = tuple(links)
        self._uids = [set(layout.uid.tolist()) for layout in layouts]
        self._of: dict[int, tuple[int, tuple[int, ...]]] = {}  # hub → table's version, links

    def links_of(self, scan: Scan) -> tuple[int, ...]:
        """Numbers of the links that a scan goes to; the first on this bus where it has no taxel of
        any."""
        if len(self.links) == 1:
            return self.links
        version, found = self._of.get(scan.ihb, (None, ()))
        if version != scan.table_version:
            uids = {uid for module in scan.table for uid in module.uids}
            pairs = zip(self.links, self._uids, strict=True)
            found = tuple(k for k, own in pairs if uids & own) or self.links[:1]
            self._of[scan.ihb] = scan.table_version, found
        return found

    def sort(self, scans: Sequence[Scan], into: Sequence[list[Scan]]) -> None:
        """Add scans to those `into` a list for each link of the configuration."""
        for scan in scans:
            for link in self.links_of(scan):
                into[link].append(scan)


def opened(
    config: Config,
    layouts: Sequence[Layout],
    open_one: Callable[[SourceConfig, Layout, int], Source],
) -> list[Bus]:
    """All buses, that of the first link first; `layouts` of each link. `open_one` is given a
    source, the layout of all that is on it, and the number of its first link.

    Raises:
        SetupError: two layouts of one bus have the same taxels, or `open_one` raises it.
    """
    found = list[Bus]()
    for source, numbers in config.buses:
        own = [layouts[k] for k in numbers]
        check_uids([config.names[k] for k in numbers], own)
        found.append(Bus(open_one(source, joint(own), numbers[0]), numbers, own))
    return found


def polled(buses: Sequence[Bus], now_s: float) -> list[list[Scan]]:
    """The scans of each link that have come by the monotonic time `now_s`."""
    came: list[list[Scan]] = [[] for bus in buses for _ in bus.links]
    for bus in buses:
        bus.sort(bus.source.poll(now_s), came)
    return came


def joint(layouts: Sequence[Layout]) -> Layout:
    """What one bus has of several layouts: their taxels, on no common cylinder."""
    if len(layouts) == 1:
        return layouts[0]
    uid, position, normal = (
        np.concatenate([getattr(each, name) for each in layouts])
        for name in ("uid", "position_m", "normal")
    )
    return Layout(" + ".join(each.name for each in layouts), uid, position, normal, math.inf)


def check_uids(names: Sequence[str], layouts: Sequence[Layout]) -> None:
    """Raises SetupError where two layouts of one bus have the same taxels."""
    pairs = zip(names, layouts, strict=True)
    for (name, one), (again, two) in combinations(pairs, 2):
        common = set(one.uid.tolist()) & set(two.uid.tolist())
        if common:
            sui = min(common) >> 4
            raise SetupError(
                f"skin.layout: {name} and {again} are on one bus, and both have module {sui}; "
                "give each link its own modules, or its own [skin.source]"
            )
