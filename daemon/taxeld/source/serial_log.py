"""The recorded bytes of a serial line, `serial.bin`, and their times, `serial.csv` beside it."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from taxeld.errors import SetupError
from taxeld.source.can_log import Damage, lines
from taxeld.source.session import SERIAL_COLUMNS, Chunk
from taxeld_protocol.serial_link import SerialReader
from taxeld_protocol.slcan import SlcanReader

ENDING = ".bin"
BLOCK = 1 << 14  # bytes: a block and its frames stay in a processor's cache
_ROW = re.compile(r"(\d{1,12}(?:\.\d{1,9})?),(\d{1,15})\s*", re.ASCII)


def framing(path: Path) -> str:
    """The framing of a line, `slcan` or `native`, by the first frame or packet.

    Raises:
        SetupError: the file is unreadable, or has neither.
    """
    slcan, native = SlcanReader(), SerialReader()
    for _, data in chunks(path, Damage()):
        if slcan.feed(data, 0.0):
            return "slcan"
        if native.feed(data, 0.0):
            return "native"
    raise SetupError(f"{path}: has neither an SLCAN frame nor a packet of a hub's serial link")


def chunks(path: Path, damage: Damage) -> Iterator[Chunk]:
    """The bytes as they were read, with their times; time 0 where no file has times.

    Raises:
        SetupError: the file is unreadable.
    """
    t, at = 0.0, 0
    try:
        with path.open("rb") as file:
            for t_next, offset in _rows(path.with_suffix(".csv"), damage):
                for data in _blocks(file, offset - at):
                    yield Chunk(t, data)
                t, at = t_next, offset
            for data in _blocks(file):
                yield Chunk(t, data)
    except OSError as error:
        raise SetupError(f"{path}: unreadable log ({error.strerror or error})") from None


def _blocks(file: BinaryIO, size: float = math.inf) -> Iterator[bytes]:
    """The next `size` bytes of a file, or as many as there are, in blocks."""
    while size > 0 and (data := file.read(int(min(size, BLOCK)))):
        size -= len(data)
        yield data


def _rows(path: Path, damage: Damage) -> Iterator[tuple[float, int]]:
    """Rows of a time and an offset; neither decreases."""
    if not path.is_file():
        damage.at(path.name, "it is not there, so that the scans have no time")
        return
    last = 0
    with path.open("rb") as file:
        for number, text in lines(file):
            row = _ROW.fullmatch(text)
            if row is not None and int(row[2]) >= last:
                last = int(row[2])
                yield float(row[1]), last
            elif text.rstrip() != ",".join(SERIAL_COLUMNS):
                damage.at(f"{path.name} line {number}", text)
