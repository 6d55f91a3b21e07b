"""`taxeld decode`: a log as JSON lines, one a scan, and then the fate of every frame.

A log is `candump -L` text, or the `serial.bin` of a session. It is read from its beginning each
time, and is never held in memory. A damaged line of text costs only itself.
"""

import json
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from taxeld.config import file as config_file
from taxeld.config import gate
from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError, one_line
from taxeld.source import modules, session
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.frames import Chunk, Frame, parse_logged

KNOWN = (
    "candump -l and -L, and serial.bin are read; 'python3 -m can.logconvert LOG OTHER.log' "
    "converts other logs"
)
ONE = "keep those of the skin's, as by grep ' can0 ' LOG"
LINE_MAX = 8192  # bytes; a CAN XL frame, the longest, has 4 150 in candump text
STANDARD_MAX, EXTENDED_MAX = 0x7FF, 0x1FFF_FFFF
SHOWN = 60  # characters of a damaged line

# Remote, FD and XL frames. Error frames look like data frames with an id above EXTENDED_MAX.
_OTHER = re.compile(r"(?:\(\d+\.\d+\) +(\S+) +)?[0-9A-Fa-f]{3,8}#(?:[R#]|[0-9A-Fa-f]{2}:)")

Listed = tuple[tuple[int, ...], ...]  # as `source.modules`

log = logging.getLogger(__name__)


@dataclass(slots=True)
class Damage:
    """Damaged lines of a log: they are left out and counted, and the first is named."""

    count: int = 0
    first: str = ""

    def at(self, number: int, text: str) -> None:
        if not self.count:
            self.first = one_line(f"line {number}: '{text.strip()[:SHOWN]}'")
        self.count += 1


def of_session(path: Path) -> Listed:
    """The modules that stand beside a log in its session; none for another log. Modules that were
    declared to the recorder (`modules.toml`) go before listed ones.

    Raises:
        ConfigError: a file of the session has faults.
    """
    if path.name in (session.FRAMES, session.SERIAL):
        if (file := path.with_name(modules.FILE)).exists():
            text = f'kind = "can"\n{config_file.text_of(file)}'
            return gate.parse(SourceConfig, text, str(file)).modules
        if (config := path.with_name(session.CONFIG)).exists():
            return config_file.load(config).source.modules
    return ()


def decode(path: Path, listed: Listed = ()) -> Iterator[str]:
    """The log's scans and a last line {"stats": …}.

    A hub's module table comes from its DECLARE and DETAILS answers; before them it is `listed`.

    Raises:
        SetupError: the log is unreadable or has no frame, or frames of several interfaces, or no
            hub's table is known.
    """
    if path.exists() and not path.is_file():
        raise SetupError(
            f"{path}: is no file; name a log, or of a session its frames.log or serial.bin"
        )
    damage, decoder = Damage(), Decoder(modules.known(listed))
    for item in _items(path, damage):
        if item is None:
            decoder.drop_foreign()
        else:
            for _, scans in decoder.take([item]):
                yield from map(_line, scans)
    yield from map(_line, decoder.flush())
    if not decoder.counters.scans and (line := modules.unplaced(decoder, f" of {path}")):
        raise SetupError(line)
    yield _json({"stats": {**decoder.stats(), "bad_lines": damage.count}})
    if damage.count:
        log.warning(
            "%s: left out what is damaged or no frame (counted as %d bad_lines), at first %s",
            path,
            damage.count,
            damage.first,
        )


def _items(path: Path, damage: Damage) -> Iterator[Frame | Chunk | None]:
    """A log in its order; None for a frame that carries nothing for a skin. Raises SetupError."""
    if path.name == session.SERIAL:
        items = (record.item for record in session.items(path.parent))
        yield from (item for item in items if isinstance(item, Chunk))
        return
    names: set[str] = set()
    try:
        with path.open("rb") as file:
            for name, frame in _candump(file, damage):
                names.add(name)
                if len(names - {""}) > 1:
                    several = ", ".join(sorted(names - {""}))
                    raise SetupError(f"{path}: has frames of several interfaces, {several}; {ONE}")
                yield frame
    except OSError as error:
        raise SetupError(f"{path}: unreadable log ({error.strerror or error})") from None
    if not names:
        first = f" ({damage.first})" if damage.count else ""
        raise SetupError(f"{path}: has no frame{first}; {KNOWN}")


def _candump(file: BinaryIO, damage: Damage) -> Iterator[tuple[str, Frame | None]]:
    """The interface, if the log names any, and the frame of each line."""
    for number, text in _lines(file):
        on, frame = parse_logged(text) or ("", None)
        if frame and frame.can_id <= (EXTENDED_MAX if frame.extended else STANDARD_MAX):
            yield on, frame
        elif frame and frame.extended:
            yield on, None
        elif other := _OTHER.match(text):
            yield other[1] or "", None
        elif not text.isspace():
            damage.at(number, text)


def _lines(file: BinaryIO) -> Iterator[tuple[int, str]]:
    """Lines with their numbers from 1 on; only the beginning of a line over LINE_MAX bytes."""
    number = 0
    while line := file.readline(LINE_MAX):
        number += 1
        yield number, line.decode("latin-1")  # any byte is a character
        while len(line) == LINE_MAX and line[-1:] != b"\n":
            line = file.readline(LINE_MAX)


def _line(scan: Scan) -> str:
    return _json({"t": scan.t, "ihb": scan.ihb, "modules": scan.by_module})


def _json(value: dict[str, object]) -> str:
    return json.dumps(value, separators=(",", ":"))
