"""A recorded session: a directory with the data that the skin and the robot sent.

`frames.log` (candump -L text), or `serial.bin` with `serial.csv` (t, offset: the bytes from
`offset` to the next row's were read at t), or `array.jsonl` (a message of an array in each line);
`sensor_pose.csv`; `config.toml`; and, from the harness,
`truth.csv`. `session.toml` has the version of the format and, once the recording has ended, the
counts of its records; a session without it is of version 1.

A recording may end anywhere: an incomplete last record is left out. Any other damage is an error.
"""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld import files
from taxeld.arrays import Poses
from taxeld.config import gate
from taxeld.config.file import load
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld_protocol import array
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.frames import Frame, parse_log_line

FRAMES, POSES, TRUTH, CONFIG = "frames.log", "sensor_pose.csv", "truth.csv", "config.toml"
SERIAL, SERIAL_TIMES, ABOUT = "serial.bin", "serial.csv", "session.toml"
ARRAY = "array.jsonl"
POSE_COLUMNS, SERIAL_COLUMNS = ["t", "x", "y", "theta"], ["t", "offset"]
VERSION = 1
COUNT_MAX = 1 << 63
LINE_MAX = 4096  # bytes; the longest line that a recorder writes has about a hundred
ARRAY_LINE_MAX = 262_144  # bytes of a line of `array.jsonl`, as of a message
ABOUT_LINES = 100  # lines of `session.toml`, which has six
SERIAL_MAX = 1 << 30  # bytes of a serial line, all held at once: hours of a full line

PoseRow = tuple[float, float, float, float]  # t, x, y, θ

log = logging.getLogger(__name__)


class Chunk(NamedTuple):
    """Bytes of a serial line that were read together."""

    t: float
    data: bytes


Items = list[Frame] | list[Chunk] | list[ArrayFrame]


def joined(items: Items) -> Items:
    """Bytes that were read one after the other as one chunk with the time of its beginning."""
    chunks = [item for item in items if isinstance(item, Chunk)]
    return [Chunk(chunks[0].t, b"".join(c.data for c in chunks))] if len(chunks) > 1 else items


@dataclass(frozen=True, slots=True)
class Session:
    """The whole records of a session, in the order of arrival."""

    items: Items
    poses: list[PoseRow]


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


def has_poses(directory: Path) -> bool:
    """Whether a robot was recorded, whose poses are then used in place of others."""
    return (directory / POSES).exists()


def begun(directory: Path) -> float:
    """Unix time at which a session began [s]; nan for an empty session. Raises SetupError."""
    if (directory / SERIAL).exists() and not (directory / FRAMES).exists():
        rows = _table(_Lines(directory / SERIAL_TIMES), SERIAL_COLUMNS)
        return rows[0][0] if rows else math.nan
    if (directory / ARRAY).exists():
        arrays = _arrays(_Lines(directory / ARRAY, ARRAY_LINE_MAX))
        return next((frame.t for frame in arrays), math.nan)
    frames = (parse_log_line(text) for text in _Lines(directory / FRAMES))
    return next((frame.t for frame in frames if frame is not None), math.nan)


def read(directory: Path) -> Session:
    """A session, up to its last whole record; a cut session is logged.

    Raises:
        SetupError: there is none, it is of a newer version, or damaged, with the line.
    """
    about = _about(directory)
    items: Items
    if (directory / SERIAL).exists() and not (directory / FRAMES).exists():
        items, cut = _chunks(directory, about)
        held = f"{sum(len(chunk.data) for chunk in items)} bytes"
    elif (directory / ARRAY).exists() and not (directory / FRAMES).exists():
        written = _Lines(directory / ARRAY, ARRAY_LINE_MAX)
        items = list(_arrays(written))
        cut = written.cut or (about is not None and about.get("frames") != len(items))
        held = f"{len(items)} arrays"
    else:
        items, cut = _frames(directory / FRAMES, about)
        held = f"{len(items)} frames"
    poses: list[PoseRow] = []
    if has_poses(directory):
        lines = _Lines(directory / POSES)
        poses = _poses(lines)
        cut |= lines.cut
    if cut or (about is not None and about.get("poses") != len(poses)):
        log.warning(
            "%s: the recording was cut; %s and %d sensor poses are whole, and used",
            directory,
            held,
            len(poses),
        )
    elif not items:
        raise SetupError(f"{directory}: holds no frames, the log is empty; record it again")
    return Session(items, poses)


def read_poses(path: Path) -> list[PoseRow]:
    """The whole rows of a pose file (`t,x,y,theta`).

    Raises:
        SetupError: the file is unreadable or damaged, with the line.
    """
    return _poses(_Lines(path))


def truth(directory: Path) -> Poses | None:
    """(3,) the object's last true pose; None where the session does not have it.

    Raises:
        SetupError: the table is damaged.
    """
    path = directory / TRUTH
    rows = read_poses(path) if path.exists() else None
    return np.array(rows[-1][1:]) if rows else None


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
    try:
        found = gate.loads("\n".join(islice(_Lines(path), ABOUT_LINES)))
    except ValueError as error:
        raise SetupError(f"{path}: damaged ({error})") from None
    if not all(type(count) is int and 0 <= count < COUNT_MAX for count in found.values()):
        raise SetupError(f"{path}: damaged (it counts what is no number)")
    version = found.pop("version", VERSION)
    if version != VERSION:
        raise SetupError(
            f"{path}: is of version {version}, where this taxeld reads {VERSION}; use a newer one"
        )
    return found


def _frames(path: Path, about: dict[str, Any] | None) -> tuple[list[Frame], bool]:
    """The frames of a log, and whether it was cut."""
    lines, frames = _Lines(path), []
    for number, text in enumerate(lines, 1):
        frame = parse_log_line(text)
        if frame is not None:
            frames.append(frame)
        elif text.strip():
            raise SetupError(f"{path}: line {number} is no candump line; the log is damaged")
    return frames, lines.cut or (about is not None and about.get("frames") != len(frames))


def _arrays(lines: _Lines) -> Iterator[ArrayFrame]:
    for number, text in enumerate(lines, 1):
        frame = array.parse(array.read_json(text))
        if isinstance(frame, str):
            raise SetupError(f"{lines.path}: line {number} is no array ({frame})")
        yield frame


def _chunks(directory: Path, about: dict[str, Any] | None) -> tuple[list[Chunk], bool]:
    """The bytes of a line as they came, and whether they were cut.

    A recorder writes bytes before the rows that date them, but a power cut may keep either. Rows
    without bytes are left out, and so are the bytes of a last row whose end no other row gives.
    """
    path, lines = directory / SERIAL, _Lines(directory / SERIAL_TIMES)
    rows = _table(lines, SERIAL_COLUMNS)
    offsets = [int(offset) for _, offset in rows]
    if offsets and (offsets[0] != 0 or offsets != sorted(offsets)):
        raise SetupError(f"{lines.path}: its offsets do not begin at 0, or fall")
    try:
        data = files.read(path, SERIAL_MAX)
    except OSError as error:
        raise SetupError(f"{path}: unreadable ({error.strerror}); record it in parts") from None
    every_row = not lines.cut if about is None else about.get("chunks") == len(rows)
    if every_row:
        offsets.append(len(data) if about is None else about.get("bytes", 0))
    chunks = [
        Chunk(row[0], data[start:end])
        for row, start, end in zip(rows, offsets, offsets[1:], strict=False)
        if start < len(data)
    ]
    return chunks, not every_row or offsets[-1] > len(data)


def _poses(lines: _Lines) -> list[PoseRow]:
    return [(row[0], row[1], row[2], row[3]) for row in _table(lines, POSE_COLUMNS)]


def _table(lines: _Lines, columns: list[str]) -> list[list[float]]:
    """The rows of a CSV file of finite numbers under the header `columns`."""
    table = []
    for number, text in enumerate(lines, 1):
        row = text.split(",")
        if number == 1:
            if row != columns:
                raise SetupError(f"{lines.path}: must begin with the line {','.join(columns)}")
            continue
        try:
            values = [float(value) for value in row]
        except ValueError:
            values = []
        if len(values) != len(columns) or not all(map(math.isfinite, values)):
            raise SetupError(f"{lines.path}: line {number} is not {','.join(columns)}")
        table.append(values)
    return table
