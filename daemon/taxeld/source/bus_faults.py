"""Faults of a CAN bus: their kinds, how many of each came, and the cure.

The kernel tells them in error frames (linux/can/error.h): their classes in the id, details in the
data. Pure: the time comes in.
"""

import math
from collections.abc import Mapping
from enum import StrEnum

PASSED_S = 10.0  # time without another fault of its kind after which one has passed
HEARD_S = 1.0  # time for which a frame shows that the bus works

POWER = "see that the skin has power"
WIRING = "check source.bitrate, the wires, and the 120 Ω at both ends of the bus"
RESTART = "'ip link set CHANNEL type can restart' (by itself: restart-ms 100)"
LOAD = "run as the service, close other programs, lengthen source.period_ms"
BUFFER = "raise net.core.rmem_default"

CONTROLLER, PROTOCOL, COUNTERS = 0x004, 0x008, 0x200  # classes with details in the data
CONTROLLER_SHIFT = 16  # the controller's own bits, data[1], stand above the classes
ACKNOWLEDGING = (0x19, 0x1B)  # place of an error in its frame, data[3]: the slot, its delimiter


class BusFault(StrEnum):
    """Kinds of faults, the gravest first: name, bits of an error frame, words and cure."""

    bits: int
    line: str

    def __new__(cls, name: str, bits: int, line: str) -> "BusFault":
        made = str.__new__(cls, name)
        made._value_, made.bits, made.line = name, bits, line
        return made

    OFF = "off", 0x040, f"bus-off, after too many errors; {WIRING}, then {RESTART}"
    TRANSCEIVER = "transceiver", 0x010, "a wire is broken or shorted; check CAN-H and CAN-L"
    NO_ACK = "no_ack", 0x020, f"nothing acknowledges; {POWER}, and {WIRING}"
    PASSIVE = "passive", 0x30_0000, f"error-passive, over 127 errors; {POWER}, and {WIRING}"
    WARNING = "warning", 0x0C_0000, f"error-warning, over 95 errors; {WIRING}"
    ERROR = "error", 0x088, f"frames are damaged on the bus; {WIRING}, its shield and stubs"
    TIMEOUT = "timeout", 0x001, f"a frame was not sent in time; unplug the adapter once; {WIRING}"
    OVERFLOW = "overflow", 0x03_0000, f"the controller lost frames, its buffers full; {LOAD}"
    UNREAD = "unread", 0, f"the kernel dropped frames, not read in time; {LOAD}, {BUFFER}"
    RESTARTED = "restarted", 0x100, f"the controller was restarted after bus-off; {WIRING}"
    ARBITRATION = "arbitration", 0x002, "another device sent first, as it may"
    ACTIVE = "active", 0x40_0000, "the controller works again, error-active"


STATES = (BusFault.OFF, BusFault.PASSIVE, BusFault.WARNING)  # told once, when they begin
RECOVERED = (BusFault.RESTARTED, BusFault.ACTIVE)  # end states
NORMAL = (BusFault.ARBITRATION, BusFault.ACTIVE)  # counted, and no fault


def kinds(classes: int, data: bytes) -> list[BusFault]:
    """The faults that an error frame tells: its id without flags, and its data."""
    _, controller, _, place, *_ = data.ljust(8, b"\0")
    bits = classes & 0xFFFF
    if classes & CONTROLLER:  # some interfaces say no more than the class
        bits |= controller << CONTROLLER_SHIFT or BusFault.WARNING.bits
    if classes & PROTOCOL and place in ACKNOWLEDGING:
        bits = bits & ~BusFault.ERROR.bits | BusFault.NO_ACK.bits
    found = [fault for fault in BusFault if fault.bits & bits]
    return found if found or classes & COUNTERS else [BusFault.ERROR]


def counted(counts: Mapping[str, int]) -> str:
    """Counts by kind in words, each with its cure; empty where all are 0."""
    faults = ((fault, counts.get(fault, 0)) for fault in BusFault)
    return "; ".join(f"{fault} {n} ({fault.line})" for fault, n in faults if n)


class BusHealth:
    def __init__(self) -> None:
        self.counts = dict.fromkeys(BusFault, 0)  # since start
        self._until_s: dict[BusFault, float] = {}  # time at which each has passed
        self._heard_s = -math.inf

    def take(self, faults: Mapping[BusFault, int], now_s: float) -> None:
        """Count so many of each kind. A state lasts until the bus works again."""
        for fault, times in faults.items():
            self.counts[fault] += times
            if fault in RECOVERED:
                self.recover(now_s)
            if fault not in NORMAL:
                self._until_s[fault] = math.inf if fault in STATES else now_s + PASSED_S

    def hear(self, now_s: float) -> None:
        """A data frame has come."""
        self._heard_s = now_s
        self.recover(now_s)

    def line(self, now_s: float) -> str:
        """The gravest fault that has not passed, and its cure; empty without one."""
        if not self._until_s:  # as of most buses
            return ""
        lasting = [fault for fault in BusFault if self._until_s.get(fault, -math.inf) > now_s]
        return f"source.channel: {lasting[0].line}" if lasting else ""

    def is_mute(self, now_s: float) -> bool:
        """Whether no data frame came lately."""
        return now_s > self._heard_s + HEARD_S

    def recover(self, now_s: float) -> None:
        """The bus works again, or its interface was opened again: no state lasts much longer."""
        for fault, until_s in self._until_s.items():
            self._until_s[fault] = min(until_s, now_s + PASSED_S)
