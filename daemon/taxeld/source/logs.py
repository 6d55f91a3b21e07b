"""A log as a file: `candump -L` text, or the bytes of a serial line (`serial.bin`) and their times.

A damaged line costs only itself. A log is read from its beginning each time, and is never held in
memory. The times of `serial.bin` stand in `serial.csv` beside it.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import BinaryIO

from taxeld.errors import SetupError, one_line
from taxeld_protocol.frames import Chunk, Frame, parse_logged

OTHERS = (".asc", ".blf", ".csv", ".db", ".gz", ".mf4", ".trc")  # formats that python-can knows
LINE_MAX = 8192  # bytes; a CAN XL frame, the longest, has 4 150 in candump text
SERIAL_ENDING = ".bin"
BLOCK = 1 << 14  # bytes of a serial line: a block and its frames stay in a processor's cache
STANDARD_MAX, EXTENDED_MAX = 0x7FF, 0x1FFF_FFFF
SHOWN = 60  # characters of a damaged line

# Remote, FD and XL frames. Error frames look like data frames with an id above EXTENDED_MAX.
_OTHER = re.compile(
    r"(?:\(\d+\.\d+\)\s+(\S+)\s+)?[0-9A-F]{3,8}#(?:[R#]|[0-9A-F]{2}:)", re.ASCII | re.IGNORECASE
)
_ROW = re.compile(r"(\d{1,12}(?:\.\d{1,9})?),(\d{1,15})(?:,(\d))?\s*", re.ASCII)
_HEADER = re.compile(r"t,offset(?:,link)?\s*")

# An interface, channel or link as the log names it, and what came by it; None for a frame that
# carries nothing for a skin.
Logged = tuple[str, Frame | Chunk | None]


@dataclass(slots=True)
class Damage:
    """Damaged parts of a log: they are left out and counted, and the first is named."""

    count: int = 0
    first: str = ""

    def at(self, where: str, text: str) -> None:
        if not self.count:
            self.first = one_line(f"{where}: '{text.strip()[:SHOWN]}'")
        self.count += 1


def read(path: Path, damage: Damage) -> Iterator[Logged]:
    """A log in its order. Bytes have time 0 where no file has times.

    Raises:
        SetupError: it is unreadable, or of another format.
    """
    if path.suffix.lower() in OTHERS:
        raise SetupError(
            f"{path}: is no candump text; make it so with "
            f"'python3 -m can.logconvert {path} {path.stem}.log'"
        )
    read = _chunks if is_serial(path) else _candump
    try:
        with path.open("rb") as file:
            yield from read(file, path, damage)
    except OSError as error:
        raise SetupError(f"{path}: unreadable log ({error.strerror or error})") from None


def is_serial(path: Path) -> bool:
    """Whether it has the bytes of a serial line."""
    return path.suffix.lower() == SERIAL_ENDING


def _lines(file: BufferedIOBase | BinaryIO) -> Iterator[tuple[int, str]]:
    """Lines with their numbers from 1 on; only the beginning of a line over LINE_MAX bytes."""
    number = 0
    while line := file.readline(LINE_MAX):
        number += 1
        yield number, line.decode("latin-1")  # any byte is a character
        while len(line) == LINE_MAX and line[-1:] != b"\n":
            line = file.readline(LINE_MAX)


def _candump(file: BinaryIO, _: Path, damage: Damage) -> Iterator[Logged]:
    for number, text in _lines(file):
        if logged := parse_logged(text):
            on, frame = logged
            if frame.can_id <= (EXTENDED_MAX if frame.extended else STANDARD_MAX):
                yield on, frame
                continue
            if frame.extended:
                yield on, None
                continue
        elif other := _OTHER.match(text):
            yield other[1] or "", None
            continue
        if not text.isspace():
            damage.at(f"line {number}", text)


def _chunks(file: BinaryIO, path: Path, damage: Damage) -> Iterator[Logged]:
    link, t, at = "", 0.0, 0
    for link_next, t_next, offset in _rows(path.with_suffix(".csv"), damage):
        for data in _blocks(file, offset - at):
            yield link, Chunk(t, data)
        link, t, at = link_next, t_next, offset
    for data in _blocks(file):
        yield link, Chunk(t, data)


def _blocks(file: BinaryIO, size: float = math.inf) -> Iterator[bytes]:
    """The next `size` bytes of a file, or as many as there are, in blocks."""
    while size > 0 and (data := file.read(int(min(size, BLOCK)))):
        size -= len(data)
        yield data


def _rows(path: Path, damage: Damage) -> Iterator[tuple[str, float, int]]:
    """Rows of a link, if the file names any, a time and an offset, which does not decrease."""
    if not path.is_file():
        damage.at(path.name, "it is not there, so that the scans have no time")
        return
    last = 0
    with path.open("rb") as file:
        for number, text in _lines(file):
            row = _ROW.fullmatch(text)
            if row is not None and int(row[2]) >= last:
                last = int(row[2])
                yield row[3] or "", float(row[1]), last
            elif not _HEADER.fullmatch(text):
                damage.at(f"{path.name} line {number}", text)
