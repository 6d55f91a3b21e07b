"""CySkin's packets and how CAN frames carry them.

A packet is `command u8 | N u8 | payload[N] | crc8`. On CAN it travels in fragments of 8 bytes, all
full but the last, under an 11-bit id of assembly bits (first, middle, last, single) and the hub's
(IHB's) short id. There is no fragment counter, so loss shows only as a wrong length or checksum.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

from taxeld_protocol.frames import Frame

FIRST, MIDDLE, LAST, SINGLE = 0x100, 0x200, 0x400, 0x500
ASSEMBLY_MASK, SHORT_ID_MASK = 0x700, 0x0FF
BROADCAST = 0xFF
FRAGMENT_BYTES = 8
MAX_PAYLOAD = 255
MAX_FRAGMENTS = -(-(MAX_PAYLOAD + 3) // FRAGMENT_BYTES)
MAX_VALUES = 126  # values in a SENSOR_DATA packet
EXCESS_MAX = FRAGMENT_BYTES - 1  # bytes after a packet: the padding of its last fragment

# One frame with a 29-bit id leads every hub out of its own bootloader: "exit" of Cypress's protocol
# (01, command 3B, no data, CRC-16/X-25, 17). As a request it has a number that no command can have.
LEAVE_BOOTLOADER = 0x100
BOOTLOADER_ID, BOOTLOADER_EXIT = 0x17FFFFFF, bytes.fromhex("013B00004F6D17")


class Command(IntEnum):
    """First byte of a packet; requests and their responses share it."""

    DISCOVERY_PING = 0x10
    DISCOVERY_RECV_ID = 0x11
    PING = 0x12
    ERROR = 0x13
    MODULE_PROGRAM_END = 0x31
    IHB_COLD_REBOOT = 0x32
    IHB_WARM_REBOOT = 0x33
    MODULE_COLD_REBOOT = 0x34
    MODULE_WARM_REBOOT = 0x35
    SET_MODULE_GROUPING = 0x36
    SET_AUTO_SYNC = 0x37
    SET_AUTO_SYNC_PERIOD = 0x38
    SET_COMM_SPEED = 0x39
    GET_COMM_SPEED = 0x3A
    SYNC = 0x3B
    DECLARE = 0x3C
    MODULE_DETAILS = 0x3D
    VERSION = 0x3E
    MODULE_BTLDR_VERSION = 0x3F
    MODULE_APP_VERSION = 0x40
    UID = 0x41
    MODULE_CDC_SPEED = 0x42
    SENSOR_DATA = 0x43
    MODULE_CDC_CONTROL = 0x44
    MODULE_PHASE_SHIFT = 0x45
    MODULE_SET_CUT_SENSORS = 0x47


KNOWN_COMMANDS = frozenset(int(command) for command in Command)
ALL_MODULES = 255


class ErrorCode(IntEnum):
    """Second payload byte of an ERROR."""

    FAIL = 0xE1
    NOT_SUPPORTED = 0xE2
    INVALID = 0xE3
    NO_COMMAND = 0xE4
    NO_ARGUMENT = 0xE5
    FORMAT = 0xE6
    CRC = 0xE7
    NO_BUFFERS = 0xE8
    PHASE = 0xE9
    BUSY = 0xEA
    IO = 0xEB


class Packet(NamedTuple):
    """A packet whose length and checksum are right."""

    t: float  # time of its first fragment, by the reader's clock [s]
    ihb: int  # short id in the CAN id: sender of a response, receiver of a request
    command: int
    payload: bytes


def _crc8_table() -> bytes:
    table = bytearray()
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x07) & 0xFF if crc & 0x80 else crc << 1
        table.append(crc)
    return bytes(table)


_CRC8 = _crc8_table()


def crc8(data: bytes | bytearray) -> int:
    """CRC-8, polynomial 0x07, init 0xFF, not reflected: 0xFB over b"123456789"."""
    crc = 0xFF
    for byte in data:
        crc = _CRC8[crc ^ byte]
    return crc


def encode(command: int, payload: bytes = b"") -> bytes:
    """The packet's bytes, checksum included."""
    body = bytes((command, len(payload))) + payload
    return body + bytes((crc8(body),))


def fragment(packet: bytes, ihb: int, t: float = 0.0) -> list[Frame]:
    """The CAN frames that carry an encoded packet to or from the hub `ihb`."""
    parts = [packet[i : i + FRAGMENT_BYTES] for i in range(0, len(packet), FRAGMENT_BYTES)]
    if len(parts) == 1:
        return [Frame(t, SINGLE | ihb, parts[0])]
    kinds = [FIRST] + [MIDDLE] * (len(parts) - 2) + [LAST]
    return [Frame(t, kind | ihb, part) for kind, part in zip(kinds, parts, strict=True)]


def to_frames(command: int, payload: bytes = b"", *, ihb: int, t: float = 0.0) -> list[Frame]:
    """A packet as CAN frames, `fragment(encode(…))`; or the frame of LEAVE_BOOTLOADER."""
    if command == LEAVE_BOOTLOADER:
        return [Frame(t, BOOTLOADER_ID, BOOTLOADER_EXIT, extended=True)]
    return fragment(encode(command, payload), ihb, t)


def scan_frames(values: int) -> int:
    """The number of CAN frames of a scan with so many values, in the fewest SENSOR_DATA packets."""
    full, rest = divmod(values, MAX_VALUES)
    return full * MAX_FRAGMENTS + (-(-(2 * rest + 5) // FRAGMENT_BYTES) if rest else 0)


@dataclass(slots=True)
class LinkCounters:
    """Every frame fed is counted exactly once among those below `frames`, or is still pending."""

    frames: int = 0
    used: int = 0  # carried a good packet
    foreign: int = 0  # extended ids and ids that are no fragment
    orphan: int = 0  # a middle or last fragment without a first
    length: int = 0  # frames of packets with a wrong length
    crc: int = 0  # frames of packets with a wrong checksum
    # The counts below are of packets.
    packets: int = 0
    length_errors: int = 0
    crc_errors: int = 0


@dataclass(slots=True)
class _Partial:
    t: float
    data: bytearray
    frames: int


@dataclass(slots=True)
class Reassembler:
    """Frames → packets, any number of hubs interleaved; memory is bounded by 256 short ids."""

    counters: LinkCounters = field(default_factory=LinkCounters)
    _partial: dict[int, _Partial] = field(default_factory=dict)

    @property
    def pending(self) -> int:
        """Frames held for packets that are not complete."""
        return sum(partial.frames for partial in self._partial.values())

    def feed(self, frame: Frame) -> Packet | None:
        """The packet that this frame completes, if it does and the packet is good."""
        counters = self.counters
        counters.frames += 1
        _, can_id, data, extended = frame
        kind, ihb = can_id & ASSEMBLY_MASK, can_id & SHORT_ID_MASK
        if kind == MIDDLE and not extended:  # most frames are
            partial = self._partial.get(ihb)
            if partial is None:
                counters.orphan += 1
                return None
            partial.data += data
            partial.frames += 1
            if partial.frames >= MAX_FRAGMENTS:
                del self._partial[ihb]
                self._drop_length(partial.frames)
            return None
        if extended or kind not in (FIRST, LAST, SINGLE):
            counters.foreign += 1
            return None
        partial = self._partial.pop(ihb, None)
        if kind == LAST:
            if partial is None:
                counters.orphan += 1
                return None
            partial.data += data
            partial.frames += 1
            return self._deliver(ihb, partial)
        if partial is not None:
            self._drop_length(partial.frames)  # the new packet cuts the old one short
        partial = _Partial(frame.t, bytearray(data), 1)
        if kind == SINGLE:
            return self._deliver(ihb, partial)
        self._partial[ihb] = partial
        return None

    def _deliver(self, ihb: int, partial: _Partial) -> Packet | None:
        data = partial.data
        # More bytes than padding after a packet come from fragments of two packets. The first's
        # checksum would let one of 256 of these pass.
        if len(data) <= 2 or not 0 <= len(data) - (data[1] + 3) <= EXCESS_MAX:
            self._drop_length(partial.frames)
            return None
        end = data[1] + 2
        if crc8(data[:end]) != data[end]:
            self.counters.crc_errors += 1
            self.counters.crc += partial.frames
            return None
        self.counters.packets += 1
        self.counters.used += partial.frames
        return Packet(partial.t, ihb, data[0], bytes(data[2:end]))

    def _drop_length(self, frames: int) -> None:
        self.counters.length_errors += 1
        self.counters.length += frames
