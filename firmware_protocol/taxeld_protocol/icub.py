"""iCub skin on CAN: a triangle's twelve values in two frames, and the commands to a board.

A board sends each of its triangles, in ascending order, as a head and a tail under the id
`0x400 | board << 4 | triangle` (0x300 until it has been configured, and in old firmware):

    head  40 t0 t1 t2 t3 t4 t5 t6
    tail  C0 t7 t8 t9 t10 t11 eH eL

Values have 8 bits and fall with pressure, from about 240 when idle. The error word eH eL has a bit
for each taxel out of range (4 + k for taxel k), bit 0 where any taxel of the triangle did not
acknowledge and bit 1 where none is connected; the shorter tails of old firmware come without it.
There is no counter, no time and no checksum beside CAN's own.

A board that is asked for its firmware (0x1C) answers under `0x200 | board << 4`, and goes on
sending. SET_BOARD disables all its triangles, also while it sends; SET_TRIANGLES enables some, has
the board calibrate itself and stops it, so that START comes last.
"""

from enum import StrEnum
from typing import NamedTuple

from taxeld_protocol.frames import Frame

BOARDS = range(1, 15)
TRIANGLES = 16  # places for triangles on a board
CHANNELS = 12  # channels of a triangle
THERMAL = (6, 10)  # channels of the common triangle that are thermal pads; a palm's are taxels

COMMAND, OLD_DATA, DATA = 0x200, 0x300, 0x400
HEAD, TAIL = 0x40, 0xC0
HEAD_VALUES, TAIL_VALUES = 7, 5

NO_ACKNOWLEDGE, NOT_CONNECTED = 1 << 0, 1 << 1
OUT_OF_RANGE_SHIFT = 4
VALUE_MAX = 255
ALL_CHANNELS = (1 << CHANNELS) - 1

SET_TX_MODE, GET_VERSION, SET_BOARD, SET_TRIANGLES = 0x07, 0x1C, 0x4D, 0x50
START, STOP = bytes((SET_TX_MODE, 0)), bytes((SET_TX_MODE, 1))
ASK = bytes((GET_VERSION, 0, 0))  # asks for kind and firmware; 0.0: any version of the protocol
ANSWER_SIZE = 8
SKIN_BOARDS = {5: "MTB", 11: "MTB4", 16: "MTB4w", 20: "MTB4c"}  # other kinds answer as well
PERIOD_MAX_MS = 209  # the timer of an MTB3 has 16 bits: 250 ms would be 40
# A board's compensation of its temperature: 0 first gains, 1 palm and fingertips, 2 not at all,
# 3 ergoCub's hand, 8 second gains
SKIN_TYPES = (0, 1, 2, 3, 8)
SKIN_TYPE = 8
NO_LOAD = 0xF0  # idle value that boards are asked for
SHIFT, CDC_OFFSET = 2, 0x2200  # the firmware's own values


class Drop(StrEnum):
    """Why a frame carries no half of a triangle."""

    FOREIGN = "foreign"  # an extended id, or none of a skin board's data
    MARK = "mark"  # first byte neither head nor tail
    LENGTH = "length"


class Half(NamedTuple):
    """The head or the tail of a triangle."""

    board: int
    triangle: int
    first: int  # channel of the first value: 0 in a head, 7 in a tail
    values: bytes
    error: int = 0  # a tail's error word; 0 in a head and without diagnostics

    @property
    def is_tail(self) -> bool:
        return self.first > 0


class Answer(NamedTuple):
    """A board's answer to ASK."""

    board: int
    kind: int  # a key of SKIN_BOARDS, or another kind of board
    version: tuple[int, int, int]  # version of its firmware

    @property
    def is_skin(self) -> bool:
        return self.kind in SKIN_BOARDS

    def __str__(self) -> str:
        name = SKIN_BOARDS.get(self.kind, f"a board of kind {self.kind}")
        return f"{name} {'.'.join(map(str, self.version))}"


def read_answer(frame: Frame) -> Answer | None:
    """A board's answer to ASK; None for any other frame."""
    board, data = frame.can_id >> 4 & 0xF, frame.data
    if frame.can_id != COMMAND | board << 4 or frame.extended or board not in BOARDS:
        return None
    if len(data) != ANSWER_SIZE or data[0] != GET_VERSION:
        return None
    return Answer(board, data[1], (data[2], data[3], data[4]))


def read(frame: Frame) -> Half | Drop:
    """The half that a frame carries, or why it carries none."""
    kind, board, triangle = frame.can_id & ~0xFF, frame.can_id >> 4 & 0xF, frame.can_id & 0xF
    if frame.extended or kind not in (DATA, OLD_DATA) or board not in BOARDS:
        return Drop.FOREIGN
    data = frame.data
    if not data:
        return Drop.LENGTH
    if data[0] == HEAD:
        if len(data) != 1 + HEAD_VALUES:
            return Drop.LENGTH
        return Half(board, triangle, 0, data[1:])
    if data[0] == TAIL:
        end = 1 + TAIL_VALUES
        if not end <= len(data) <= end + 2:
            return Drop.LENGTH
        error = int.from_bytes(data[end:]) if len(data) == end + 2 else 0
        return Half(board, triangle, HEAD_VALUES, data[1:end], error)
    return Drop.MARK


def unusable(error: int) -> int:
    """The channels whose values an error word takes back: bit k for channel k.

    One taxel that fails sets NO_ACKNOWLEDGE for its triangle, and its own bit: the others are fine.
    """
    if error & NOT_CONNECTED:
        return ALL_CHANNELS
    return error >> OUT_OF_RANGE_SHIFT


def set_board(period_ms: int, skin_type: int = SKIN_TYPE, no_load: int = NO_LOAD) -> bytes:
    """The command that sets a board's period [ms, 1..209], one of SKIN_TYPES and its idle value,
    and disables all its triangles."""
    if not 1 <= period_ms <= PERIOD_MAX_MS:
        raise ValueError(f"a period of {period_ms} ms is not 1..{PERIOD_MAX_MS}")
    return bytes((SET_BOARD, skin_type, period_ms, no_load))


def set_triangles(
    first: int = 0,
    last: int = TRIANGLES - 1,
    shift: int = SHIFT,
    cdc_offset: int = CDC_OFFSET,
    *,
    enable: bool = True,
) -> bytes:
    """The command that sets up triangles first..last: whether they are sent, the bits that a raw
    capacitance is shifted by, and its offset (u16). The board calibrates all, and stops."""
    return bytes((SET_TRIANGLES, first, last, shift, enable)) + cdc_offset.to_bytes(2, "little")


def runs(mask: int) -> list[tuple[int, int]]:
    """The first and last of each unbroken row of triangles in a mask, ascending."""
    edges = (mask << 1) ^ mask  # bit k: triangle k is in and k − 1 is not, or the reverse
    ends = [k for k in range(TRIANGLES + 1) if edges >> k & 1]
    return [(first, after - 1) for first, after in zip(ends[::2], ends[1::2], strict=True)]


def to_frames(board: int, command: bytes, t: float = 0.0) -> list[Frame]:
    """A command to a board, which fits one CAN frame."""
    return [Frame(t, COMMAND | board, command)]
