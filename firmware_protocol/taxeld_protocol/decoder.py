"""CySkin frames → scans: reassembly, the module table as traffic tells it, the SENSOR_DATA walk."""

import struct
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import accumulate

from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import Command, Packet, Reassembler
from taxeld_protocol.frames import Chunk, Frame
from taxeld_protocol.modules import Module, ModuleTable, is_of_bootloader
from taxeld_protocol.serial_link import SerialReader

MISSING = -1  # a channel of a scan that no packet filled
DEFAULT_PERIOD_S = 0.05  # time between scans
GAP_SHARE = 0.8  # share of the period: packets farther apart belong to two scans
MISSED_SHARE = 1.5  # share of the period: between scans farther apart, one is missing
PAUSE_MAX_S = 1.0  # after a longer pause the hub, or the clock, has begun anew


@dataclass(frozen=True, slots=True)
class Scan:
    """One pass over all channels of a hub."""

    t: float  # time of the first packet's first fragment, by the reader's clock [s]
    ihb: int
    counts: tuple[int, ...]  # channel by channel, MISSING where lost
    table: tuple[Module, ...]  # modules of the channels, in the order of the counts
    table_version: int
    rest: int = 0  # counts of all taxels at rest, where the sender knows them; 0: they are learned
    link: int = 0  # number of the robot's link whose taxels these are

    @property
    def complete(self) -> bool:
        return MISSING not in self.counts

    @property
    def by_module(self) -> list[list[int | None]]:
        """Counts of each module, None where lost."""
        out: list[list[int | None]] = []
        at = 0
        for module in self.table:
            part = self.counts[at : at + module.channels]
            out.append([None if value == MISSING else value for value in part])
            at += module.channels
        return out


@dataclass(slots=True)
class Counters:
    """Packets and scans; frames are counted by the link."""

    index_errors: int = 0  # SENSOR_DATA past the declared tree, or malformed
    malformed: int = 0  # other packets whose payload does not suit their command
    unknown: int = 0  # packets of no known command, and frames of no known id
    undeclared: int = 0  # SENSOR_DATA before the module table was known, or of a hub refused
    bootloader: int = 0  # answers of hubs whose modules are in their bootloader
    scans: int = 0
    incomplete: int = 0  # scans with a lost channel
    missed: int = 0  # scans that a short pause between two scans of a hub had room for


@dataclass(slots=True)
class _Hub:
    """A hub's table, and the scan under way."""

    table: ModuleTable = field(default_factory=ModuleTable)
    asked: bool = False  # whether `assumed` was asked for its table
    walk_version: int = -1  # version of the table from which the walk was made
    walk: tuple[Module, ...] = ()
    first: list[int] = field(default_factory=list)  # first channel of each module in the scan
    channels: int = 0
    counts: list[int] | None = None  # None: no scan is under way
    t: float | None = None
    last_t: float = 0.0  # time of its last packet [s]
    reached: int = 0  # one past the last channel filled: a scan only walks forward

    def learn(self) -> None:
        """Make the walk from the table."""
        self.walk_version = self.table.version
        self.walk = tuple(self.table.modules)
        self.first = [0, *accumulate(module.channels for module in self.walk)]
        self.channels = self.first.pop()

    def channel(self, module: int, channel: int) -> int | None:
        """The scan's channel at which a packet that names (module, channel) starts."""
        if module < len(self.walk) and channel < self.walk[module].channels:
            return self.first[module] + channel
        return None


class Decoder:
    """Any number of hubs on one bus. Feed frames; take scans; read the counters."""

    def __init__(
        self,
        assumed: Callable[[int], Sequence[Module]] | None = None,
        period_s: float = DEFAULT_PERIOD_S,
    ) -> None:
        """`assumed`: short id → the modules of a hub that streams without having told them, as when
        listening to a skin that was started before; empty where they are not known. It is asked
        once a hub. `period_s`: of the scans. When the end of one scan and the beginning of the next
        are lost, only the pause between what is left tells that they are two."""
        self.link = Reassembler()
        self.line = SerialReader()
        self.counters = Counters()
        self.hubs: defaultdict[int, _Hub] = defaultdict(_Hub)
        self._assumed = assumed
        self._period_s = period_s
        self._gap_s = GAP_SHARE * period_s

    def table(self, ihb: int) -> ModuleTable:
        """The module table of a hub, empty until it is declared."""
        return self.hubs[ihb].table if ihb in self.hubs else ModuleTable()

    @property
    def refusal(self) -> str:
        """A line on a hub that is not read, as it is not known which taxel is which; or empty."""
        faults = ((ihb, hub.table.fault) for ihb, hub in self.hubs.items())
        return next((f"hub {ihb} is refused: {fault}" for ihb, fault in faults if fault), "")

    @property
    def tables(self) -> dict[int, list[Module]]:
        """Short id → modules, of the hubs that told any; a hub may be refused for what it told."""
        return {ihb: hub.table.modules for ihb, hub in self.hubs.items() if hub.table.modules}

    def forget(self, ihb: int) -> None:
        """Forget the declarations under a short id: another hub has it now. The next table under
        this id has a version of its own."""
        self.hubs[ihb] = _Hub(ModuleTable(version=self.hubs[ihb].table.version + 1))

    def take(self, items: Iterable[Frame | Chunk]) -> Iterator[tuple[Packet, list[Scan]]]:
        """The packets that frames of a bus, or bytes of a line, complete, and the scans that each
        of them ends: at most two."""
        for item in items:
            if isinstance(item, Frame):
                if (packet := self.link.feed(item)) is not None:
                    yield packet, self.on_packet(packet)
            else:
                for packet in self.line.feed(item.data, item.t):
                    yield packet, self.on_packet(packet)

    def drop_foreign(self, frames: int = 1) -> None:
        """Count frames that are no classic data frames."""
        self.link.counters.frames += frames
        self.link.counters.foreign += frames

    def on_packet(self, packet: Packet) -> list[Scan]:
        """Take a packet that came whole, from CAN or a serial link."""
        command = packet.command
        if command not in cyskin.KNOWN_COMMANDS:
            self.counters.unknown += 1
            return []
        if command == Command.SENSOR_DATA:
            return self._sensor_data(packet)
        if packet.ihb != cyskin.BROADCAST and command in (Command.DECLARE, Command.MODULE_DETAILS):
            table = self.hubs[packet.ihb].table
            self.counters.bootloader += is_of_bootloader(command, packet.payload)
            take = table.on_declare if command == Command.DECLARE else table.on_details
            if not take(packet.payload):
                self.counters.malformed += 1
        return []

    def flush(self) -> list[Scan]:
        """The scans that are under way, incomplete: call at the end of a log."""
        scans: list[Scan] = []
        for ihb, hub in self.hubs.items():
            self._end(ihb, hub, scans)
        return scans

    def stats(self) -> dict[str, int | dict[str, int]]:
        """All counters; `frames` = `used` + the sum of `dropped` + `pending`."""
        link: dict[str, int] = asdict(self.link.counters)
        dropped = {cause: link.pop(cause) for cause in ("crc", "length", "orphan", "foreign")}
        counters = asdict(self.counters)
        counters["unknown"] += dropped["foreign"]
        line = asdict(self.line.counters)
        size, used = line.pop("bytes"), line.pop("used")
        counters |= {"bytes": size, "bytes_used": used}
        counters["bytes_dropped"] = size - used - self.line.pending
        if size:  # a serial line has packets, and no frames
            link |= line
        return {**link, "dropped": dropped, "pending": self.link.pending, **counters}

    def _sensor_data(self, packet: Packet) -> list[Scan]:
        payload = packet.payload
        if not payload:
            return []  # the host's request
        hub = self.hubs[packet.ihb]
        if self._assumed is not None and not hub.asked:
            hub.asked = True
            if not hub.table.detailed:
                self._assume(hub, self._assumed(packet.ihb))
        if not hub.table.declared or hub.table.fault:
            self.counters.undeclared += 1
            return []
        scans: list[Scan] = []
        if hub.walk_version != hub.table.version:  # a new table ends the scan of the old one
            self._end(packet.ihb, hub, scans)
            hub.learn()
        start = hub.channel(*payload[:2]) if len(payload) % 2 == 0 else None
        if start is None:
            self.counters.index_errors += 1
            return scans
        # a step back or a pause begins the next scan
        if start < hub.reached or packet.t - hub.last_t > self._gap_s:
            self._end(packet.ihb, hub, scans)
        hub.last_t = packet.t
        if hub.counts is None:
            self._count_missed(hub, packet.t)
            hub.counts = [MISSING] * hub.channels
            hub.t = packet.t
        values = struct.unpack(f">{len(payload) // 2 - 1}H", payload[2:])
        fitting = values[: hub.channels - start]
        if len(fitting) < len(values):
            self.counters.index_errors += 1
        hub.reached = start + len(fitting)
        hub.counts[start : hub.reached] = fitting
        if hub.reached == hub.channels:
            self._end(packet.ihb, hub, scans)
        return scans

    @staticmethod
    def _assume(hub: _Hub, modules: Sequence[Module]) -> None:
        """Take modules that the wire did not tell, unless they contradict what it did tell."""
        told = [module.channels for module in hub.table.modules]
        if modules and told in ([], [module.channels for module in modules]):
            hub.table = ModuleTable(list(modules), hub.table.version + 1)

    def _count_missed(self, hub: _Hub, t: float) -> None:
        """A scan begins at t: a loss of whole packets shows by nothing but the time without one."""
        if hub.t is None:
            return
        pause = t - hub.t
        if MISSED_SHARE * self._period_s < pause <= PAUSE_MAX_S:
            self.counters.missed += round(pause / self._period_s) - 1

    def _end(self, ihb: int, hub: _Hub, scans: list[Scan]) -> None:
        """Move the scan under way, if there is one, to `scans`."""
        if hub.counts is None or hub.t is None:
            return
        scan = Scan(hub.t, ihb, tuple(hub.counts), hub.walk, hub.walk_version)
        hub.counts, hub.reached = None, 0
        self.counters.scans += 1
        self.counters.incomplete += not scan.complete
        scans.append(scan)
