"""SLCAN, the Lawicel ASCII form of CAN on a serial line.

`t` and `T` carry data frames with 11- and 29-bit ids: id digits, one digit of length, the data, the
time stamp of some adapters, carriage return. `r` and `R` are remote frames, and `d`, `D`, `b`, `B`
CAN FD's of some adapters. An adapter answers a host's lines with CR, or BEL where it refuses.
"""

import re
from binascii import unhexlify
from dataclasses import dataclass, field

from taxeld_protocol.frames import Frame

CR, BEL = b"\r", b"\a"
ZERO, ID_MAX = ord("0"), 0x7FF
STAMP_BYTES = (0, 2, 4)  # an adapter may add its time: none, in ms, or in µs
MAX_LINE = 1 + 8 + 1 + 16 + 8  # bytes of a frame with the longest stamp; a longer line is noise
ACCEPTED = (b"", b"z", b"Z")  # answers to a command; some adapters answer `t` by z, `T` by Z
NO_DATA = (b"d", b"D", b"b", b"B")  # lines of CAN FD, longer than a kept line

# Lawicel's bit rate codes; CANable's S7 is 750 000
BITRATES = {
    10_000: b"S0",
    20_000: b"S1",
    50_000: b"S2",
    100_000: b"S3",
    125_000: b"S4",
    250_000: b"S5",
    500_000: b"S6",
    800_000: b"S7",
    1_000_000: b"S8",
}

_FRAME = re.compile(
    rb"(?:t([0-7][0-9A-Fa-f]{2})|T([01][0-9A-Fa-f]{7}))([0-8])((?:[0-9A-Fa-f]{2}){0,12})"
)
_REMOTE = re.compile(rb"(?:r[0-7][0-9A-Fa-f]{2}|R[01][0-9A-Fa-f]{7})[0-8](?:[0-9A-Fa-f]{4}){0,2}")


def encode(frame: Frame) -> bytes:
    """The frame as an SLCAN line."""
    head = f"T{frame.can_id:08X}" if frame.extended else f"t{frame.can_id:03X}"
    return f"{head}{len(frame.data)}{frame.data.hex().upper()}\r".encode()


def split(buffer: bytes) -> tuple[list[bytes], bytes]:
    """Whole lines without their CR, and the rest; a line that BEL ended keeps it. The rest is cut
    to MAX_LINE + 1 bytes: so a line that is too long stays too long, however its bytes come."""
    *lines, rest = buffer.replace(BEL, BEL + CR).split(CR)
    return lines, rest[: MAX_LINE + 1]


def parse(line: bytes, t: float = 0.0) -> Frame | None:
    """A line as a data frame without its time stamp; None for answers and damage."""
    if line[:1] == b"t" and 5 <= len(line) <= 21 and len(line) == 5 + 2 * (line[4] - ZERO):
        try:  # nearly all lines are of this form
            read = unhexlify(b"0" + line[1:4] + line[5:])
        except ValueError:
            return None
        can_id = read[0] << 8 | read[1]
        return Frame(t, can_id, read[2:]) if can_id <= ID_MAX else None
    match = _FRAME.fullmatch(line.removesuffix(BEL))
    if match is None:
        return None
    short, long, length, digits = match.groups()
    size = int(length)
    data = bytes.fromhex(digits.decode())
    if len(data) - size not in STAMP_BYTES:
        return None
    return Frame(t, int(long or short, 16), data[:size], long is not None)


def carries_no_data(line: bytes) -> bool:
    """Whether it is a remote frame, or one of CAN FD."""
    return line.startswith(NO_DATA) or _REMOTE.fullmatch(line) is not None


@dataclass(slots=True)
class SlcanReader:
    """Bytes in pieces of any size → frames."""

    foreign: int = 0  # remote frames and CAN FD frames so far
    others: list[bytes] = field(default_factory=list)  # of the last lines, those that are no frame
    _rest: bytes = b""

    def feed(self, data: bytes, t: float) -> list[Frame]:
        """The data frames that `data` completes, stamped with `t`; foreign ones are counted."""
        lines, self._rest = split(self._rest + data)
        frames, self.others = [], []
        for line in lines:
            frame = parse(line, t)
            if frame is not None:
                frames.append(frame)
            else:
                self.foreign += carries_no_data(line)
            if frame is None or line[-1:] == BEL:
                self.others.append(line)
        return frames
