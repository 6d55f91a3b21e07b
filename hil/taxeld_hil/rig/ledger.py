"""The ledger: all that went over the wire to the host, and what the host must have counted of it.

It knows which packet each frame was cut from, and so the fate of every packet: whole, damaged, or
never there. The daemon's counters must agree with it (`reconcile`), to the last frame.
"""

import math
from collections import Counter
from dataclasses import asdict, dataclass
from itertools import accumulate
from typing import Any, NamedTuple

from taxeld.source.session import Item
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.cyskin import EXCESS_MAX, MAX_FRAGMENTS, Command, crc8
from taxeld_protocol.decoder import GAP_SHARE, MISSED_SHARE, PAUSE_MAX_S
from taxeld_protocol.frames import Chunk, Frame


class Sent(NamedTuple):
    """A packet as the hub sent it."""

    data: bytes  # on CAN the packet's, on the native link the line's
    command: int
    fragments: int = 1
    start: int = 0  # SENSOR_DATA: the first channel
    values: int = 0  # number of values in the packet
    declares: bool = False  # the modules' channels


class WireUnit(NamedTuple):
    """One piece on the wire: a CAN frame, a line of the native link, or an array."""

    item: Frame | bytes | ArrayFrame
    sent: Sent | None  # None: nothing of the skin's
    part: int = 0  # number of the fragment

    def at(self, t: float) -> Item:
        """As it goes to the host, and into a recording, at time t."""
        return Chunk(t, self.item) if isinstance(self.item, bytes) else self.item._replace(t=t)


@dataclass(slots=True)
class Fates:
    """Expected counts of all that was delivered since this host began to listen."""

    units: int = 0  # frames, lines of the native link, or arrays
    bytes: int = 0  # bytes in the serial lines
    foreign: int = 0  # units that are not the skin's
    orphan: int = 0  # frames without a first
    packets: int = 0  # packets that arrived whole
    length_errors: int = 0
    crc_errors: int = 0
    line_errors: int = 0  # lines of the native link, with either error
    undetected: int = 0  # damaged packets whose checksum is right
    unclear: int = 0  # undetected packets other than SENSOR_DATA, whose fate is open
    index_errors: int = 0  # undetected packets for a module or channel that does not exist
    undeclared: int = 0  # SENSOR_DATA before the modules were declared
    scans: int = 0
    incomplete: int = 0
    missed: int = 0


class Ledger:
    """Counts of all that was sent in one run; `fates` begin anew with each host."""

    def __init__(self, modules: tuple[int, ...], period_s: float) -> None:
        """`modules`: channels of each; `period_s` is infinite where it is not known when the host
        reads."""
        self.modules, self.period_s = modules, period_s
        self._first = [0, *accumulate(modules)]
        self.done = Counter[str]()  # acts of the injector, by kind of fault
        self.poses_sent = 0
        self.refused = 0  # units that the host did not make room for
        self.hosts = 0
        self._last_t = 0.0  # time of the last packet [s]
        self.begin()

    def begin(self) -> None:
        """A host listens from now on."""
        self.hosts += 1
        self.fates = Fates()
        self.poses_heard = 0
        self._open, self._declared = list[WireUnit](), False
        self._reached = self._filled = 0  # channels of the scan that has begun
        self._t: float | None = None  # time of the last scan's first packet [s]

    @property
    def knows_pauses(self) -> bool:
        """Whether it divides scans where the host does: at pauses between the packets it reads."""
        return math.isfinite(self.period_s)

    def deliver(self, unit: WireUnit, t: float) -> None:
        """The host was handed this at time t."""
        fates = self.fates
        fates.units += 1
        if isinstance(unit.item, ArrayFrame):
            fates.scans += 1
            fates.incomplete += 0 in unit.item.counts
        elif isinstance(unit.item, bytes):
            self._line(unit, unit.item, t)
        elif unit.sent is None:
            fates.foreign += 1
        else:
            self._frame(unit, unit.sent, t)

    def entries(self, *others: "Ledger") -> dict[str, Any]:
        """As a session keeps it, with what the ledgers of the host's other hubs have counted."""
        each = (self, *others)
        return {
            "done": dict(sorted(sum((one.done for one in each), Counter[str]()).items())),
            "poses_heard": sum(one.poses_heard for one in each),
            "refused": sum(one.refused for one in each),
            "hosts": self.hosts,
            "knows_pauses": self.knows_pauses,
            "fates": {k: sum(getattr(one.fates, k) for one in each) for k in asdict(self.fates)},
        }

    def _line(self, unit: WireUnit, line: bytes, t: float) -> None:
        self.fates.bytes += len(line)
        if unit.sent is None or line != unit.sent.data:
            self.fates.foreign += unit.sent is None
            self.fates.line_errors += 1
        else:
            self._arrived(unit.sent, t)

    def _frame(self, unit: WireUnit, sent: Sent, t: float) -> None:
        if unit.part == 0:
            self.fates.length_errors += bool(self._open)  # the packet before was cut short
            self._open = []
        elif not self._open:
            self.fates.orphan += 1
            return
        self._open.append(unit)
        if unit.part == sent.fragments - 1:
            parts, self._open = self._open, []
            self._judge(parts, t)
        elif len(self._open) >= MAX_FRAGMENTS:
            self._open = []
            self.fates.length_errors += 1

    def _judge(self, parts: list[WireUnit], t: float) -> None:
        """Fragments from a first to a last, which need not be of one packet."""
        fates, sent = self.fates, parts[0].sent
        data = b"".join(part.item.data for part in parts if isinstance(part.item, Frame))
        if len(data) <= 2 or not 0 <= len(data) - (data[1] + 3) <= EXCESS_MAX:
            fates.length_errors += 1
        elif sent is not None and data[: len(sent.data)] == sent.data:
            self._arrived(sent, t)
        elif crc8(data[: data[1] + 2]) != data[data[1] + 2]:
            fates.crc_errors += 1
        else:
            fates.undetected += 1
            fates.packets += 1
            self._passed(data[: data[1] + 2], t)

    def _passed(self, packet: bytes, t: float) -> None:
        """A damaged packet that looks like a good one."""
        if packet[0] != Command.SENSOR_DATA:
            self.fates.unclear += 1
        elif len(packet) < 4 or not self._declared:
            self.fates.undeclared += len(packet) >= 3
        else:
            module, channel, values = packet[2], packet[3], len(packet) // 2 - 2
            is_place = module < len(self.modules) and channel < self.modules[module]
            if len(packet) % 2 or not is_place:
                self.fates.index_errors += 1
                return
            start = self._first[module] + channel
            fitting = min(values, self._first[-1] - start)
            self.fates.index_errors += fitting < values
            self._scan(Sent(packet, packet[0], 1, start, fitting), t)

    def _arrived(self, sent: Sent, t: float) -> None:
        self.fates.packets += 1
        if sent.declares:
            self._declared = True
        elif sent.command == Command.SENSOR_DATA:
            self._scan(sent, t)

    def _scan(self, sent: Sent, t: float) -> None:
        """A packet of a scan: which scan, by the rules of docs/protocol.md."""
        if not self._declared:
            self.fates.undeclared += 1
            return
        if sent.start < self._reached or t - self._last_t > GAP_SHARE * self.period_s:
            self._end()
        self._last_t = t
        if not self._filled:
            pause = 0.0 if self._t is None else t - self._t
            if MISSED_SHARE * self.period_s < pause <= PAUSE_MAX_S:
                self.fates.missed += round(pause / self.period_s) - 1
            self._t = t
        self._reached = sent.start + sent.values
        self._filled += sent.values
        if self._reached == self._first[-1]:
            self._end()

    def _end(self) -> None:
        if self._filled:
            self.fates.scans += 1
            self.fates.incomplete += self._filled < self._first[-1]
        self._reached = self._filled = 0
