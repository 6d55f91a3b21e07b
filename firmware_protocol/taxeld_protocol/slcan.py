"""SLCAN, the Lawicel ASCII form of CAN on a serial line: bytes in → (events, rest) out.

`t` and `T` carry data frames with 11- and 29-bit ids: id digits, one digit of length, the data,
carriage return. An adapter answers a host's commands with CR, or BEL where it cannot.
"""

from taxeld_protocol.frames import Frame

CR, BEL = b"\r", b"\a"
MAX_LINE = 1 + 8 + 1 + 16  # of a frame; anything longer is noise


def encode(frame: Frame) -> bytes:
    """The frame as an SLCAN line."""
    head = f"T{frame.can_id:08X}" if frame.extended else f"t{frame.can_id:03X}"
    return f"{head}{len(frame.data)}{frame.data.hex().upper()}\r".encode()


def split(buffer: bytes) -> tuple[list[bytes], bytes]:
    """Whole lines without their CR, and the rest, which is bounded: noise without CR is dropped."""
    *lines, rest = buffer.split(CR)
    return lines, rest if len(rest) <= MAX_LINE else b""


def parse(line: bytes, t: float = 0.0) -> Frame | None:
    """A line as a data frame; None for commands, answers and damage."""
    digits = {b"t": 3, b"T": 8}.get(line[:1])
    if digits is None or len(line) < digits + 2:
        return None
    try:
        can_id = int(line[1 : 1 + digits], 16)
        length = int(line[1 + digits : 2 + digits])
        data = bytes.fromhex(line[2 + digits :].decode("ascii"))
    except ValueError:
        return None
    if length > 8 or len(data) != length:
        return None
    return Frame(t, can_id, data, digits == 8)
