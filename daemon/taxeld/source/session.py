"""A recorded session: a directory with the data that the skin and the robot sent.

`frames.log` (candump -L text), `serial.bin` with `serial.csv` (t, offset: the bytes from `offset`
to the next row's were read at t), and `array.jsonl` (a message of an array in each line), each
where a source of its kind was; `sensor_pose.csv`; `config.toml`; and, from the harness,
`truth.csv`. `session.toml` has the version of the format and, once the recording has ended, the
counts of its records; a session without it is of version 1.

With several links both tables have a column `link`, and the interface of a frame is can0, can1 …:
the number of the link, and of a source the number of the first link on it.

A recording may end anywhere: an incomplete last record is left out. Any other damage is an error.
"""

import heapq
import logging
import math
import re
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from taxeld import files
from taxeld.arrays import Poses
from taxeld.config import gate
from taxeld.config.file import load
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld_protocol import array
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.frames import Chunk, Frame, parse_logged

FRAMES, POSES, TRUTH, CONFIG = "frames.log", "sensor_pose.csv", "truth.csv", "config.toml"
SERIAL, SERIAL_TIMES, ABOUT = "serial.bin", "serial.csv", "session.toml"
ARRAY = "array.jsonl"
POSE_COLUMNS, SERIAL_COLUMNS, LINK = ["t", "x", "y", "theta"], ["t", "offset"], "link"
VERSION = 2  # version 1 had a folder for each further link
COUNT_MAX = 1 << 63
LINE_MAX = 4096  # bytes; the longest line that a recorder writes has about a hundred
ARRAY_LINE_MAX = 262_144  # bytes of a line of `array.jsonl`, as of a message
ABOUT_LINES = 100  # lines of `session.toml`, which has six
BLOCK = 1 << 16  # bytes of a serial line that are held at once
BACK_S = 0.25  # where times fall by as much, the recorder's clock was set back
INTERFACE = re.compile(r"can(\d)", re.ASCII)

PoseRow = tuple[float, float, float, float]  # t, x, y, θ
Item = Frame | Chunk | ArrayFrame | PoseRow

log = logging.getLogger(__name__)


class Record(NamedTuple):
    steps: int  # number of times that the recorder's clock had been set back
    t: float
    link: int  # of a pose; of other items: the first link of their source
    item: Item


def config_of(directory: Path, given: Path | None = None) -> Config:
    """The configuration of a session, or the `given` one in its place.

    Raises:
        SetupError: there is no session, or the configuration has faults.
    """
    if not directory.is_dir() or not (given or (directory / CONFIG).is_file()):
        raise SetupError(
            f"{directory}: is no session (it has no {CONFIG}); 'taxeld record' and "
            "'taxeld run --record' make one"
        )
    return load(given or directory / CONFIG)


def records(directory: Path) -> Iterator[Record]:
    """A session in the order of arrival, up to its last whole record, which is never held whole. At
    its end, the log has one line on what is missing of a cut session.

    Raises:
        SetupError: there is none, it is of another version, or damaged, with the line.
    """
    reading = _Reading(directory)
    yield from reading.merged()
    reading.end()


def items(directory: Path) -> Iterator[Record]:
    """As `records`, without poses and without a line on what is missing."""
    return _Reading(directory).merged(poses=False)


def begun(directory: Path) -> float:
    """Unix time at which a session began [s]; nan for an empty session. Raises SetupError."""
    return next((record.t for record in items(directory)), math.nan)


def read_poses(path: Path) -> list[PoseRow]:
    """The whole rows of a pose file (`t,x,y,theta`).

    Raises:
        SetupError: the file is unreadable or damaged, with the line.
    """
    return [(row[0], row[1], row[2], row[3]) for _, row in _table(_Lines(path), POSE_COLUMNS)]


def truth(directory: Path) -> Poses | None:
    """(3,) the object's last true pose; None where the session does not have it.

    Raises:
        SetupError: the table is damaged.
    """
    path = directory / TRUTH
    rows = read_poses(path) if path.exists() else None
    return np.array(rows[-1][1:]) if rows else None


class _Reading:
    """One reading of a session's files, which counts what it reads."""

    def __init__(self, directory: Path) -> None:
        self._directory, self._about = directory, _about(directory)
        self._counts = dict.fromkeys(("frames", "chunks", "bytes", "poses"), 0)
        self._files: list[_Lines] = []
        self._lacks_bytes = False

    def merged(self, *, poses: bool = True) -> Iterator[Record]:
        found: dict[str, Callable[[], Iterator[tuple[int, Item]]]]
        found = {SERIAL: self._chunks, FRAMES: self._frames, ARRAY: self._arrays}
        if poses:  # the first of those of the same time
            found = {POSES: self._poses, **found}
        there = [read for name, read in found.items() if (self._directory / name).exists()]
        streams = [_dated(read()) for read in there]
        return heapq.merge(*streams, key=lambda record: record[:2])

    def end(self) -> None:
        """All is read: log what is missing. Raises SetupError where nothing was recorded."""
        counts, about = self._counts, self._about
        is_cut = self._lacks_bytes or any(lines.cut for lines in self._files)
        if is_cut or (about is not None and about != counts):
            named = {"frames": "frames", "bytes": "bytes", "poses": "sensor poses"}
            told = [
                f"{counts[key]}{f' of {about[key]}' if about and key in about else ''} {name}"
                for key, name in named.items()
                if counts[key] or (about and about.get(key))
            ]
            whole = ", ".join(told) or "nothing"
            log.warning("%s: the recording was cut; used are %s", self._directory, whole)
        elif not (counts["frames"] or counts["bytes"]):
            raise SetupError(f"{self._directory}: holds no frames, it is empty; record it again")

    def _lines(self, name: str, longest: int = LINE_MAX) -> "_Lines":
        self._files.append(_Lines(self._directory / name, longest))
        return self._files[-1]

    def _frames(self) -> Iterator[tuple[int, Frame]]:
        lines = self._lines(FRAMES)
        for number, text in enumerate(lines, 1):
            if logged := parse_logged(text):
                self._counts["frames"] += 1
                on = INTERFACE.fullmatch(logged[0])
                yield int(on[1]) if on else 0, logged[1]
            elif text.strip():
                where = f"{lines.path}: line {number}"
                raise SetupError(f"{where} is no candump line; the log is damaged")

    def _arrays(self) -> Iterator[tuple[int, ArrayFrame]]:
        lines = self._lines(ARRAY, ARRAY_LINE_MAX)
        for number, text in enumerate(lines, 1):
            frame = array.parse(array.read_json(text))
            if isinstance(frame, str):
                raise SetupError(f"{lines.path}: line {number} is no array ({frame})")
            self._counts["frames"] += 1
            yield 0, frame  # one array is heard at most

    def _poses(self) -> Iterator[tuple[int, PoseRow]]:
        for link, (t, x, y, theta) in _table(self._lines(POSES), POSE_COLUMNS):
            self._counts["poses"] += 1
            yield link, (t, x, y, theta)

    def _chunks(self) -> Iterator[tuple[int, Chunk]]:
        """A recorder writes bytes before the rows that date them, but a power cut may keep either.
        Rows without bytes are left out, and so are the bytes of a last row whose end is not known:
        no other row gives it."""
        lines, path = self._lines(SERIAL_TIMES), self._directory / SERIAL
        link, t, at = 0, 0.0, 0
        try:
            with files.opened(path) as file:
                for link_next, (t_next, offset) in _table(lines, SERIAL_COLUMNS):
                    if offset < at or (not self._counts["chunks"] and offset):
                        raise SetupError(f"{lines.path}: its offsets do not begin at 0, or fall")
                    for data in self._bytes(file, int(offset) - at):
                        yield link, Chunk(t, data)
                    self._counts["chunks"] += 1
                    link, t, at = link_next, t_next, int(offset)
                about, rows = self._about, self._counts["chunks"]
                if rows and about is None and not lines.cut:
                    for data in iter(lambda: file.read(BLOCK), b""):
                        self._counts["bytes"] += len(data)
                        yield link, Chunk(t, data)
                elif rows and about is not None and about.get("chunks") == rows:
                    for data in self._bytes(file, about.get("bytes", 0) - at):
                        yield link, Chunk(t, data)
        except OSError as error:
            raise SetupError(f"{path}: unreadable ({error.strerror})") from None

    def _bytes(self, file: BinaryIO, size: int) -> Iterator[bytes]:
        """The next so many bytes of the file, or as many as there are."""
        while size > 0 and (data := file.read(min(size, BLOCK))):
            size -= len(data)
            self._counts["bytes"] += len(data)
            yield data
        self._lacks_bytes |= size > 0


def _dated(items: Iterable[tuple[int, Item]]) -> Iterator[Record]:
    """Records of one file. Only a step back of the clock shows in it: a step forward looks like a
    pause."""
    steps, before = 0, -math.inf
    for link, item in items:
        t = item[0]
        steps += before - t >= BACK_S
        before = t
        yield Record(steps, t, link, item)


class _Lines:
    """The lines of a file whose last line may be cut: a line without its end is left out."""

    def __init__(self, path: Path, longest: int = LINE_MAX) -> None:
        self.path, self._longest = path, longest
        self.cut = False  # whether the last line was cut; known after the last line

    def __iter__(self) -> Iterator[str]:
        number = 0
        try:
            with files.opened(self.path) as file:
                while line := file.readline(self._longest):
                    number += 1
                    if line[-1:] != b"\n":
                        if len(line) == self._longest and b"\0" not in line:  # as power cuts leave
                            fault = f"line {number} is longer than {self._longest} bytes"
                            raise SetupError(f"{self.path}: damaged ({fault})")
                        self.cut = True
                        return
                    yield line.decode("ascii", "replace").rstrip("\r\n")
        except OSError as error:
            raise SetupError(f"{self.path}: unreadable ({error.strerror})") from None


def _about(directory: Path) -> dict[str, Any] | None:
    """The counts of `session.toml`, empty before the recording has ended; None without the file."""
    path = directory / ABOUT
    if not path.exists():
        return None
    found = gate.loads("\n".join(islice(_Lines(path), ABOUT_LINES)), str(path))
    if not all(type(count) is int and 0 <= count < COUNT_MAX for count in found.values()):
        raise SetupError(f"{path}: damaged (it counts what is no number)")
    version = found.pop("version", 1)
    if not 1 <= version <= VERSION:
        raise SetupError(
            f"{path}: is of version {version}, where this taxeld reads {VERSION}; use a newer one"
        )
    found.pop("dropped", None)
    return found


def _table(lines: _Lines, columns: list[str]) -> Iterator[tuple[int, list[float]]]:
    """The rows of a CSV file of finite numbers under the header `columns`, and the link of each:
    its last column, where the header has one; else 0."""
    headers = {len(columns): columns, len(columns) + 1: [*columns, LINK]}
    header: list[str] = []
    for number, text in enumerate(lines, 1):
        row = text.split(",")
        if number == 1:
            header = headers.get(len(row), columns)
            if row != header:
                raise SetupError(f"{lines.path}: must begin with the line {','.join(columns)}")
            continue
        try:
            values = [float(value) for value in row]
        except ValueError:
            values = []
        if len(values) != len(header) or not all(map(math.isfinite, values)):
            raise SetupError(f"{lines.path}: line {number} is not {','.join(header)}")
        yield (int(values.pop()) if len(header) > len(columns) else 0), values
