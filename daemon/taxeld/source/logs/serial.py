"""The recorded bytes of a serial line, `serial.bin`, and their times, `serial.csv` beside it."""

import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from taxeld.source.logs.text import BLOCK, Damage, Readable, blocks
from taxeld.source.session import SERIAL_COLUMNS, Chunk
from taxeld_protocol.serial_link import SerialReader
from taxeld_protocol.slcan import SlcanReader

FRAMINGS = ("slcan", "native")
_ROW = re.compile(r"(\d{1,12}(?:\.\d{1,9})?),(\d{1,15})\r?", re.ASCII)


def told(file: Readable) -> str | None:
    """The framing of a recorded line, by the first frame or packet; None: it carries neither."""
    slcan, native = SlcanReader(), SerialReader()
    while data := file.read(BLOCK):
        if slcan.feed(data, 0.0):
            return "slcan"
        if native.feed(data, 0.0):
            return "native"
    return None


def times(path: Path) -> Path:
    """Where the times of recorded bytes stand."""
    return path.with_name(path.name.removesuffix(".gz")).with_suffix(".csv")


def chunks(file: Readable, times: Path, damage: Damage) -> Iterator[Chunk]:
    """The bytes as they were read, with their times; all of time 0 where there are none."""
    t, at = 0.0, 0
    for t_next, offset in _rows(times, damage):
        yield from _pieces(file, offset - at, t)
        t, at = t_next, offset
    while data := file.read(BLOCK):
        yield Chunk(t, data)


def _pieces(file: Readable, size: int, t: float) -> Iterator[Chunk]:
    while size > 0 and (data := file.read(min(size, BLOCK))):
        size -= len(data)
        yield Chunk(t, data)


def _rows(path: Path, damage: Damage) -> Iterator[tuple[float, int]]:
    """Times and offsets, which do not fall."""
    if not path.is_file():
        damage.at(path.name, "it is not there, so that the scans have no time")
        return
    last = 0
    with closing(path.open("rb")) as file:
        for number, text in blocks(file):
            for place, line in enumerate(text.split("\n"), number):
                row = _ROW.fullmatch(line)
                if row is not None and int(row[2]) >= last:
                    last = int(row[2])
                    yield float(row[1]), last
                elif line.rstrip("\r") != ",".join(SERIAL_COLUMNS):
                    damage.at(f"{path.name} line {place}", line)
