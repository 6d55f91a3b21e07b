"""SLCAN, the Lawicel ASCII form of CAN on a serial line.

`t` and `T` carry data frames with 11- and 29-bit ids: id digits, one digit of length, the data,
carriage return. An adapter answers a host's commands with CR, or BEL where it cannot.
"""

import re
from dataclasses import dataclass, field

from taxeld_protocol.frames import Frame

CR, BEL = b"\r", b"\a"
TIME_BYTES = 2  # an adapter may add its time stamp in ms
MAX_LINE = 1 + 8 + 1 + 16 + 4  # of a frame, with an adapter's time stamp; anything longer is noise

# Lawicel's bit rate codes
BITRATES = {
    10_000: b"S0", 20_000: b"S1", 50_000: b"S2", 100_000: b"S3", 125_000: b"S4",
    250_000: b"S5", 500_000: b"S6", 800_000: b"S7", 1_000_000: b"S8",
}  # fmt: skip


_LINE = re.compile(
    rb"(?:t([0-7][0-9A-Fa-f]{2})|T([01][0-9A-Fa-f]{7}))([0-8])((?:[0-9A-Fa-f]{2}){0,10})"
)


def encode(frame: Frame) -> bytes:
    """The frame as an SLCAN line."""
    head = f"T{frame.can_id:08X}" if frame.extended else f"t{frame.can_id:03X}"
    return f"{head}{len(frame.data)}{frame.data.hex().upper()}\r".encode()


def open_commands(bitrate: int, listen_only: bool) -> bytes:
    """What a host writes to an adapter: close, set the rate, open."""
    return b"C\r" + BITRATES[bitrate] + (b"\rL\r" if listen_only else b"\rO\r")


def split(buffer: bytes) -> tuple[list[bytes], bytes]:
    """Whole lines without their CR, and the rest. Of a line that is too long enough is kept to know
    it by, so that its end is not taken for a line of its own however the bytes are cut."""
    *lines, rest = buffer.replace(BEL, CR).split(CR)
    return lines, rest[: MAX_LINE + 1]


def parse(line: bytes, t: float = 0.0) -> Frame | None:
    """A line as a data frame, its time stamp passed over; None for answers and damage."""
    match = _LINE.fullmatch(line)
    if match is None:
        return None
    short, long, length, digits = match.groups()
    size = int(length)
    data = bytes.fromhex(digits.decode())
    if len(data) not in (size, size + TIME_BYTES):
        return None
    return Frame(t, int(long or short, 16), data[:size], long is not None)


@dataclass(slots=True)
class SlcanCounters:
    """Bytes that were fed and were no frame, answers and damage, are those not counted as used."""

    bytes: int = 0
    used: int = 0
    frames: int = 0


@dataclass(slots=True)
class SlcanReader:
    """Bytes in pieces of any size → frames."""

    counters: SlcanCounters = field(default_factory=SlcanCounters)
    _rest: bytes = b""

    @property
    def pending(self) -> int:
        """Bytes held for a line that is not complete."""
        return len(self._rest)

    def feed(self, data: bytes, t: float) -> list[Frame]:
        """The frames that `data` completes, stamped with `t`."""
        self.counters.bytes += len(data)
        lines, self._rest = split(self._rest + data)
        frames = []
        for line in lines:
            frame = parse(line, t)
            if frame is not None:
                self.counters.used += len(line) + 1
                self.counters.frames += 1
                frames.append(frame)
        return frames
