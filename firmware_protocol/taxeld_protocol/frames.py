"""What comes over a wire as values: CAN frames, with their candump text, and bytes of a line."""

import re
from typing import NamedTuple


class Frame(NamedTuple):
    """A classic CAN data frame."""

    t: float  # s, by the reader's clock: CySkin has none
    can_id: int
    data: bytes  # at most 8 bytes
    extended: bool = False


class Chunk(NamedTuple):
    """Bytes of a serial line that were read together."""

    t: float
    data: bytes


# candump -L: "(1700000000.123456) can0 101#431A000027102711"; ids of 8 digits are extended. The
# digits of a time are bounded, as no clock has more and no float holds 400.
_LINE = re.compile(
    r"(?:\((?P<t>\d{1,12}\.\d{1,9})\)\s+\S+\s+)?(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})#"
    r"(?P<data>(?:[0-9A-Fa-f]{2}){0,8})(?:\s+[RT])?\s*",
    re.ASCII,
)


def parse_log_line(text: str) -> Frame | None:
    """The frame of a line of `candump -L`, or of its bare `id#data`; None for anything else."""
    match = _LINE.fullmatch(text)
    if match is None:
        return None
    digits, t = match["id"], float(match["t"] or 0.0)
    return Frame(t, int(digits, 16), bytes.fromhex(match["data"]), len(digits) == 8)


def format_log_line(frame: Frame, channel: str = "can0") -> str:
    """The frame as `candump -L` writes it, without the newline."""
    width = 8 if frame.extended else 3
    return f"({frame.t:.6f}) {channel} {frame.can_id:0{width}X}#{frame.data.hex().upper()}"
