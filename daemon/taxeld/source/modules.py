"""The modules of a CySkin hub in streaming order, where its DECLARE was not heard.

A hub has its own order, which is not by serial number, and no layout knows it. With a guess nearly
all taxels would lie in the wrong place. So the order comes from `source.modules`, or from anywhere
in a recording, or is unknown.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.frames import Chunk, Frame
from taxeld_protocol.modules import Module, listed

FILE = "modules.toml"
CURE = (
    f"list them as [SUI, mask] in the order in which the hub sends them: 'taxeld record' writes "
    f"that list ({FILE}) where it starts the skin itself"
)


class ListedModules:
    """The modules listed by `source.modules`, by hub. A list without hubs belongs to one hub: the
    first that asks."""

    def __init__(self, entries: Iterable[Sequence[int]]) -> None:
        self._by_hub: dict[int | None, list[tuple[int, int]]] = {}
        for sui, mask, *hub in entries:
            self._by_hub.setdefault(hub[0] if hub else None, []).append((sui, mask))

    def __bool__(self) -> bool:
        return bool(self._by_hub)

    def of(self, ihb: int) -> list[Module]:
        """The modules of a hub; empty where it is not in the list."""
        if None in self._by_hub:
            self._by_hub = {ihb: self._by_hub[None]}
        return listed(self._by_hub.get(ihb, ()))


class RecordedModules:
    """The modules found in a recording, or listed by `source.modules`."""

    def __init__(
        self,
        given: ListedModules,
        items: Callable[[], Iterable[Frame | Chunk]],
        what: str,
        *,
        placed: bool = True,
    ) -> None:
        """`items` reads the recording; `what`: its name in messages. Unless its taxels are to be
        `placed`, a DECLARE alone tells a hub's modules."""
        self._given, self._items, self._what, self._is_placed = given, items, what, placed

    def of(self, ihb: int) -> list[Module]:
        """The modules of a hub that streams before it has declared them; empty where only other
        hubs' modules are known.

        Raises:
            SetupError: no hub's modules are known.
        """
        found = self._declared.get(ihb) or self._given.of(ihb)
        if not (found or self._declared or self._given):
            raise SetupError(missing(f"hub {ihb} of {self._what}"))
        return found

    @cached_property
    def _declared(self) -> dict[int, list[Module]]:
        decoder = Decoder()
        for _ in decoder.take(self._items()):
            pass
        return placed(decoder) if self._is_placed else _declared(decoder)


def given(config: SourceConfig, layout: Layout) -> ListedModules:
    """The modules listed by `source.modules`.

    Raises:
        SetupError: none of them is in the layout.
    """
    known = {int(uid) >> 4 for uid in layout.uid}
    if config.modules and not any(sui in known for sui, *_ in config.modules):
        first, *_ = config.modules[0]
        raise SetupError(
            f"source.modules: none of its {len(config.modules)} modules is in {layout.name}, "
            f"not even {first}; list those of this skin"
        )
    return ListedModules(config.modules)


def complete(decoder: Decoder) -> dict[int, list[Module]]:
    """Short id → modules, for the hubs that declared all of theirs, and are not refused."""
    tables = {ihb: hub.table for ihb, hub in decoder.hubs.items()}
    return {ihb: t.modules for ihb, t in tables.items() if t.detailed and not t.fault}


def _declared(decoder: Decoder) -> dict[int, list[Module]]:
    """Short id → modules, for the hubs that declared any."""
    return {ihb: hub.table.modules for ihb, hub in decoder.hubs.items() if hub.table.declared}


def placed(decoder: Decoder) -> dict[int, list[Module]]:
    """The same, where one of them at least told its serial number: else no taxel has a place."""
    tables = _declared(decoder)
    return {ihb: t for ihb, t in tables.items() if any(m.sui is not None for m in t)}


def missing(hub: str) -> str:
    """A line for a hub that streams data without a known place."""
    return (
        f"source.modules: {hub} streams, but its answers to DECLARE and MODULE_DETAILS were not "
        f"heard, so which taxel is which is not known; {CURE}"
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
