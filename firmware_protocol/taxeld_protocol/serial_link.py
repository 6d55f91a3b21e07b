"""The native serial link: `short id u8 | command u8 | N u8 | payload | CRC-16` in one COBS frame.

The CRC-16 (CCITT, init 0xFFFF, big-endian, over all before it) takes the place of the packet's own
CRC-8; 0x00 delimits frames.
"""

import binascii
from dataclasses import dataclass, field

from taxeld_protocol.cyskin import MAX_PAYLOAD, Packet

DELIMITER = b"\0"
MAX_DECODED = 1 + 2 + MAX_PAYLOAD + 2
MAX_ENCODED = MAX_DECODED + MAX_DECODED // 254 + 1


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing (Cheshire & Baker 1999), without the delimiter."""
    out = bytearray()
    for block in data.split(b"\0"):
        full = len(block) // 254 * 254
        for at in range(0, full, 254):
            out += b"\xff" + block[at : at + 254]
        out.append(len(block) - full + 1)
        out += block[full:]
    return bytes(out)


def cobs_decode(data: bytes) -> bytes | None:
    """The inverse; None if `data` is no COBS frame."""
    out = bytearray()
    at = 0
    while at < len(data):
        code = data[at]
        block = data[at + 1 : at + code]
        if code == 0 or len(block) != code - 1 or 0 in block:
            return None
        out += block
        at += code
        if code < 255 and at < len(data):
            out.append(0)
    return bytes(out)


def encode(command: int, payload: bytes = b"", *, ihb: int) -> bytes:
    """A packet as it stands on the line, delimiter included."""
    body = bytes((ihb, command, len(payload))) + payload
    crc = binascii.crc_hqx(body, 0xFFFF).to_bytes(2, "big")
    return cobs_encode(body + crc) + DELIMITER


@dataclass(slots=True)
class SerialCounters:
    """Counts of bytes and packets; `bytes` less `used` and the pending belong to no good packet."""

    bytes: int = 0
    used: int = 0
    packets: int = 0
    length_errors: int = 0
    crc_errors: int = 0


@dataclass(slots=True)
class SerialReader:
    """Bytes in pieces of any size → packets."""

    counters: SerialCounters = field(default_factory=SerialCounters)
    _rest: bytearray = field(default_factory=bytearray)
    _skipping: bool = False  # past a line that is too long, up to its delimiter

    @property
    def pending(self) -> int:
        """Bytes held for a frame that is not complete."""
        return len(self._rest)

    def feed(self, data: bytes, t: float) -> list[Packet]:
        """The good packets that `data` completes, stamped with `t`."""
        counters = self.counters
        counters.bytes += len(data)
        self._rest += data
        *frames, rest = self._rest.split(DELIMITER)
        if frames and self._skipping:
            self._skipping = False
            del frames[0]  # the end of a line that was too long
        if len(rest) > MAX_ENCODED and not self._skipping:
            counters.length_errors += 1
            self._skipping = True  # no frame is that long: its end is no frame either
        self._rest = bytearray() if self._skipping else rest
        packets = []
        for frame in frames:
            packet = self._decode(bytes(frame), t)
            if packet is not None:
                counters.used += len(frame) + 1
                counters.packets += 1
                packets.append(packet)
        return packets

    def _decode(self, frame: bytes, t: float) -> Packet | None:
        if not frame:
            return None  # repeated delimiters resynchronise, and are no error
        data = cobs_decode(frame)
        if data is None or len(data) < 5 or len(data) != data[2] + 5:
            self.counters.length_errors += 1
            return None
        if binascii.crc_hqx(data[:-2], 0xFFFF) != int.from_bytes(data[-2:], "big"):
            self.counters.crc_errors += 1
            return None
        return Packet(t, data[0], data[1], data[3:-2])
