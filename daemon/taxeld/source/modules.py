"""The modules of a CySkin hub in streaming order, where its DECLARE was not heard.

A hub has its own order, which is not by serial number, and no layout knows it. With a guess nearly
all taxels would lie in the wrong place. So the order is told on the wire, or by `source.modules`,
or is unknown.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import Module, listed

FILE = "modules.toml"
CURE = (
    "list them as [SUI, mask] in the order in which the hub sends them: 'taxeld export' writes "
    f"that list ({FILE}) of a session in which taxeld has started the skin"
)


def check(config: SourceConfig, layout: Layout) -> None:
    """Raises SetupError where none of the listed modules is in the layout."""
    known = {int(uid) >> 4 for uid in layout.uid}
    if config.modules and not any(sui in known for sui, *_ in config.modules):
        first, *_ = config.modules[0]
        raise SetupError(
            f"source.modules: none of its {len(config.modules)} modules is in {layout.name}, "
            f"not even {first}; list those of this skin"
        )


def known(entries: Iterable[Sequence[int]]) -> Callable[[int], list[Module]]:
    """Short id → modules, as `source.modules` lists them; empty where it does not. A list without
    hubs belongs to one hub: the first that asks."""
    by_hub = defaultdict[int | None, list[tuple[int, int]]](list)
    for sui, mask, *hub in entries:
        by_hub[hub[0] if hub else None].append((sui, mask))

    def of(ihb: int) -> list[Module]:
        if None in by_hub:
            by_hub[ihb] = by_hub.pop(None)
        return listed(by_hub.get(ihb, ()))

    return of


def complete(decoder: Decoder) -> dict[int, list[Module]]:
    """Short id → modules, of the hubs that told all of theirs, and are not refused."""
    tables = {ihb: hub.table for ihb, hub in decoder.hubs.items()}
    return {ihb: t.modules for ihb, t in tables.items() if t.detailed and not t.fault}


def unplaced(decoder: Decoder, where: str = "") -> str:
    """A line where hubs stream and no taxel of theirs has a known place; else empty. `where`: words
    on the recording that they are in."""
    placed = any(m.sui is not None for table in decoder.tables.values() for m in table)
    if placed or not (decoder.counters.undeclared or decoder.counters.scans):
        return ""
    first = next(iter(decoder.hubs))
    return (
        f"source.modules: hub {first}{where} streams, but its answers to DECLARE and "
        f"MODULE_DETAILS were not heard, so which taxel is which is not known; {CURE}"
    )


def write(path: Path, tables: Mapping[int, Sequence[Module]]) -> None:
    """Write the list of the hubs' modules to a new file, ready for `[source]`. Raises OSError."""
    columns = "[SUI, mask, hub]" if len(tables) > 1 else "[SUI, mask]"
    lines = [
        f"# {columns} in the order in which the modules send: for [source] of a configuration that",
        "# listens to this skin while something else starts it (listen_only)",
        "modules = [",
    ]
    for ihb, modules in sorted(tables.items()):
        hub = f", {ihb}" if len(tables) > 1 else ""
        lines += [f"  [{module.sui or 0}, 0x{module.mask:03X}{hub}]," for module in modules]
    with path.open("x", encoding="utf-8") as file:
        file.write("\n".join([*lines, "]", ""]))
