"""A recorded session: a directory with what the skin and the robot sent.

`frames.log` (candump -L text), or `serial.bin` with `serial.csv` (t, offset: the byte at `offset`
and those up to the next row's were read at t); `sensor_pose.csv`; `config.toml`; and, from the
harness, `truth.csv`.
"""

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple, Self

from taxeld.errors import SetupError
from taxeld_protocol.frames import Frame, LogLine, format_log_line, parse_log_line

FRAMES, POSES, TRUTH, CONFIG = "frames.log", "sensor_pose.csv", "truth.csv", "config.toml"
SERIAL, SERIAL_TIMES = "serial.bin", "serial.csv"
POSE_COLUMNS, SERIAL_COLUMNS = ["t", "x", "y", "theta"], ["t", "offset"]

PoseRow = tuple[float, float, float, float]  # t, x, y, θ


class Chunk(NamedTuple):
    """Bytes of a serial line that were read together."""

    t: float
    data: bytes


def read_input(directory: Path) -> list[Frame] | list[Chunk]:
    """What the skin of a session sent, which must be whole.

    Raises:
        SetupError: there is nothing, or it is damaged, with the line.
    """
    serial = directory / SERIAL
    if serial.exists() and not (directory / FRAMES).exists():
        return _read_chunks(serial, directory / SERIAL_TIMES)
    return read_frames(directory / FRAMES)


def log_lines(path: Path) -> Iterator[LogLine]:
    """The lines of a candump log; damaged ones with no frame, empty ones left out.

    Raises:
        SetupError: the file cannot be read.
    """
    try:
        with path.open(encoding="ascii", errors="replace") as file:
            for number, text in enumerate(file, 1):
                if text.strip():
                    yield LogLine(number, parse_log_line(text.rstrip("\n")))
    except OSError as error:
        raise SetupError(f"{path}: unreadable log ({error.strerror})") from None


def read_frames(path: Path) -> list[Frame]:
    """All frames of a log, which must be whole.

    Raises:
        SetupError: the file is unreadable, empty, or damaged, with the line.
    """
    frames = []
    for line in log_lines(path):
        if line.frame is None:
            raise SetupError(
                f"{path}: line {line.number} is no candump line; the log is truncated or damaged"
            )
        frames.append(line.frame)
    if not frames:
        raise SetupError(f"{path}: holds no frames; the log is empty")
    return frames


def read_poses(path: Path) -> list[PoseRow]:
    """The rows of a pose file (`t,x,y,theta`).

    Raises:
        SetupError: the file is unreadable or damaged, with the line.
    """
    return [(row[0], row[1], row[2], row[3]) for row in _read_table(path, POSE_COLUMNS)]


class Recorder:
    """Writes a session directory as input arrives."""

    def __init__(self, directory: Path, *, moves: bool) -> None:
        """`moves`: whether a robot tells where the sensor is.

        Raises:
            SetupError: the directory cannot be made, or holds a session already.
        """
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SetupError(f"{directory}: cannot be made ({error.strerror})") from None
        for name in (FRAMES, SERIAL, POSES):
            if (directory / name).exists():
                raise SetupError(f"{directory}: holds a session already; name another directory")
        self.frames = self.bytes = self.poses = 0
        self._directory = directory
        self._open: dict[str, IO[str]] = {}
        self._serial: IO[bytes] | None = None
        if moves:
            self._table(POSES, POSE_COLUMNS)

    def take(self, item: Frame | Chunk) -> None:
        """A CAN frame, either way; or bytes that came on a serial line."""
        if isinstance(item, Frame):
            self._frame(item)
        else:
            self._chunk(item)

    def _frame(self, frame: Frame) -> None:
        if FRAMES not in self._open:
            self._open[FRAMES] = (self._directory / FRAMES).open("w", encoding="ascii")
        self._open[FRAMES].write(format_log_line(frame) + "\n")
        self.frames += 1

    def _chunk(self, chunk: Chunk) -> None:
        if self._serial is None:
            self._serial = (self._directory / SERIAL).open("wb")
            self._table(SERIAL_TIMES, SERIAL_COLUMNS)
        self._open[SERIAL_TIMES].write(f"{chunk.t:.6f},{self.bytes}\n")
        self._serial.write(chunk.data)
        self.bytes += len(chunk.data)

    def pose(self, t: float, x: float, y: float, theta: float) -> None:
        """A sensor pose in the world."""
        self._open[POSES].write(f"{t:.6f},{x!r},{y!r},{theta!r}\n")
        self.poses += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for file in self._open.values():
            file.close()
        if self._serial is not None:
            self._serial.close()

    def _table(self, name: str, columns: list[str]) -> None:
        self._open[name] = (self._directory / name).open("w", encoding="ascii")
        self._open[name].write(",".join(columns) + "\n")


def _read_chunks(path: Path, times: Path) -> list[Chunk]:
    rows = _read_table(times, SERIAL_COLUMNS)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SetupError(f"{path}: unreadable ({error.strerror})") from None
    offsets = [int(offset) for _, offset in rows]
    if not offsets or offsets[0] != 0 or offsets != sorted(offsets) or offsets[-1] > len(data):
        raise SetupError(f"{times}: its offsets do not fit the {len(data)} bytes of {path.name}")
    ends = [*offsets[1:], len(data)]
    return [
        Chunk(row[0], data[start:end]) for row, start, end in zip(rows, offsets, ends, strict=True)
    ]


def _read_table(path: Path, columns: list[str]) -> list[list[float]]:
    """The rows of a CSV file of finite numbers under the header `columns`."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SetupError(f"{path}: unreadable ({error})") from None
    if not rows or rows[0] != columns:
        raise SetupError(f"{path}: must begin with the line {','.join(columns)}")
    table = []
    for number, row in enumerate(rows[1:], 2):
        try:
            values = [float(text) for text in row]
        except ValueError:
            values = []
        if len(values) != len(columns) or not all(map(math.isfinite, values)):
            raise SetupError(f"{path}: line {number} is not {','.join(columns)}")
        table.append(values)
    return table
