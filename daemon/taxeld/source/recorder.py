"""Writes a session as it comes: taken without waiting, and written by a thread of its own.

Files are only ever appended to, whole records at a time, the bytes of a line before the rows that
date them. Whatever ends a recording, `session.read` finds all but its last moment. A disk that is
slow costs records, which are counted, and one that is full ends the recording: never the caller.
"""

import contextlib
import logging
import os
import threading
import time
from collections import deque
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Self

from taxeld.errors import SetupError
from taxeld.source.session import (
    ABOUT,
    CONFIG,
    FRAMES,
    POSE_COLUMNS,
    POSES,
    SERIAL,
    SERIAL_COLUMNS,
    SERIAL_TIMES,
    VERSION,
    Chunk,
    PoseRow,
)
from taxeld_protocol.frames import Frame, format_log_line

PAUSE_S = 0.25  # between two writings: short, so that none holds the interpreter for long
SYNC_S = 5.0  # what a power cut may cost
CLOSE_S = 5.0  # that the last writing may take
BATCH = 500  # records that are formatted and written at once
WAITING_BYTES = 16_000_000  # that may wait for the disk: 10 s of a full bus
RECORD_BYTES = 200  # of memory that a record takes beside its data, roughly

Item = Frame | Chunk | PoseRow

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RecordCounters:
    """What was written, and what was not, since the start."""

    frames: int = 0
    bytes: int = 0  # of a serial line
    poses: int = 0
    dropped: int = 0  # records of any kind that the disk did not take, or not in time
    failed: bool = False  # the disk took no more, and the recording has ended


class Recorder:
    """Writes a session directory while it is entered.

    A recording into which nothing came leaves nothing behind.
    """

    def __init__(
        self,
        directory: Path,
        *,
        moves: bool,
        config: Path | None = None,
        calibration: Path | None = None,
    ) -> None:
        """`moves`: whether a robot tells where the sensor is; `config` is kept with the session,
        and so is the `calibration` that it names, where it lies beside it.

        Raises:
            SetupError: the directory holds a session already.
        """
        for name in (ABOUT, FRAMES, SERIAL, SERIAL_TIMES, POSES):
            if (directory / name).exists():
                raise SetupError(f"{directory}: holds a session already; name another directory")
        self._directory = directory
        self._moves = moves
        self._config = config
        self._calibration = calibration
        self._waiting: deque[Item] = deque()
        self._offered = self._taken = 0  # bytes: the caller's count, and the thread's
        self._refused = self._lost = 0  # records, likewise
        self._failed = False
        self._closing = threading.Event()

    @property
    def counters(self) -> RecordCounters:
        """As far as has been written."""
        files = self._files
        return RecordCounters(
            files.frames, files.bytes, files.poses, self._refused + self._lost, self._failed
        )

    def take(self, item: Frame | Chunk) -> None:
        """A CAN frame, either way; or bytes that came on a serial line."""
        self._offer(item, RECORD_BYTES + len(item.data))

    def pose(self, t: float, x: float, y: float, theta: float) -> None:
        """A sensor pose in the world."""
        self._offer((t, x, y, theta), RECORD_BYTES)

    def __enter__(self) -> Self:
        """Raises SetupError where the directory cannot be made or written to."""
        try:
            self._files = SessionFiles(
                self._directory,
                moves=self._moves,
                config=self._config,
                calibration=self._calibration,
            )
        except OSError as error:
            reason = error.strerror
            raise SetupError(f"{self._directory}: cannot be made ({reason})") from None
        # a disk that hangs must not keep the process from ending
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            self._fail(f"the disk did not take the last of it within {CLOSE_S:g} s")

    def _offer(self, item: Item, size: int) -> None:
        if self._failed or self._offered - self._taken > WAITING_BYTES:
            self._refused += 1
            return
        self._offered += size
        self._waiting.append(item)

    def _run(self) -> None:
        next_sync_s = time.monotonic()
        with contextlib.closing(self._files) as files:
            try:
                closing = False
                while not closing:
                    closing = self._closing.wait(PAUSE_S)
                    for _ in range(0, len(self._waiting), BATCH):
                        self._write_some()
                    if time.monotonic() >= next_sync_s:
                        files.sync()
                        next_sync_s = time.monotonic() + SYNC_S
                files.end(self._refused)
            except OSError as error:
                self._fail(error.strerror or str(error))
                self._lost += len(self._waiting)
                self._waiting.clear()

    def _write_some(self) -> None:
        batch = [self._waiting.popleft() for _ in range(min(BATCH, len(self._waiting)))]
        try:
            self._files.write(batch)
        except OSError:
            self._lost += len(batch)
            raise
        for item in batch:
            self._taken += RECORD_BYTES
            if isinstance(item, Frame | Chunk):
                self._taken += len(item.data)

    def _fail(self, reason: str) -> None:
        self._failed = True
        log.warning(
            "%s: the recording has ended (%s); it replays up to here", self._directory, reason
        )


class SessionFiles:
    """The files of a session, appended to. All of it raises OSError."""

    def __init__(
        self, directory: Path, *, moves: bool, config: Path | None, calibration: Path | None = None
    ) -> None:
        self.frames = self.chunks = self.bytes = self.poses = 0
        self._directory = directory
        self._open: dict[str, FileIO] = {}
        self._unsynced_names = True
        self._made = [path for path in (directory, *directory.parents) if not path.exists()]
        try:
            directory.mkdir(parents=True, exist_ok=True)
            _append(self._file(ABOUT), f"version = {VERSION}\n".encode())
            if config is not None and not self._is_own(config):
                _append(self._file(CONFIG), config.read_bytes())
                self._keep_beside(config, calibration)
            if moves:
                self._table(POSES, POSE_COLUMNS)
        except OSError:
            self._discard()
            raise

    def write(self, items: list[Item]) -> None:
        """Append records."""
        line, rows, frames, poses = bytearray(), bytearray(), bytearray(), bytearray()
        counts = [0, 0, 0]
        for item in items:
            if isinstance(item, Frame):
                frames += format_log_line(item).encode() + b"\n"
                counts[0] += 1
            elif isinstance(item, Chunk):
                rows += b"%.6f,%d\n" % (item.t, self.bytes + len(line))
                line += item.data
                counts[1] += 1
            else:
                t, x, y, theta = item
                poses += f"{t:.6f},{x!r},{y!r},{theta!r}\n".encode()
                counts[2] += 1
        if line:
            if SERIAL not in self._open:
                self._table(SERIAL_TIMES, SERIAL_COLUMNS)
            _append(self._file(SERIAL), line)
            _append(self._file(SERIAL_TIMES), rows)
        if frames:
            _append(self._file(FRAMES), frames)
        if poses:
            _append(self._file(POSES), poses)
        self.frames += counts[0]
        self.chunks += counts[1]
        self.bytes += len(line)
        self.poses += counts[2]

    def sync(self) -> None:
        """Onto the disk."""
        for file in self._open.values():
            os.fsync(file.fileno())
        if self._unsynced_names:
            self._unsynced_names = False
            for path in (self._directory, *(path.parent for path in self._made)):
                _sync_directory(path)

    def end(self, dropped: int) -> None:
        """Nothing more will come."""
        if not (self.frames or self.bytes or self.poses):
            self._discard()
            return
        self.sync()
        counted = {
            "dropped": dropped,
            "frames": self.frames,
            "chunks": self.chunks,
            "bytes": self.bytes,
            "poses": self.poses,
        }
        text = "".join(f"{name} = {count}\n" for name, count in counted.items())
        _append(self._open[ABOUT], text.encode())
        os.fsync(self._open[ABOUT].fileno())

    def close(self) -> None:
        for file in self._open.values():
            with contextlib.suppress(OSError):
                file.close()

    def _file(self, name: str) -> FileIO:
        if name not in self._open:
            path = self._directory / name
            if not path.exists():
                self._made.insert(0, path)
            self._open[name] = FileIO(path, "w")
            self._unsynced_names = True
        return self._open[name]

    def _table(self, name: str, columns: list[str]) -> None:
        _append(self._file(name), ",".join(columns).encode() + b"\n")

    def _is_own(self, config: Path) -> bool:
        """Whether that is the session's own configuration already."""
        path = self._directory / CONFIG
        return path.exists() and path.samefile(config)

    def _keep_beside(self, config: Path, calibration: Path | None) -> None:
        """A calibration that the configuration names by a path beside its own: at that path beside
        the session's."""
        if calibration is None or not calibration.is_file():
            return
        try:
            name = str(calibration.relative_to(config.parent))
        except ValueError:
            return
        if ".." in Path(name).parts or (self._directory / name).exists():
            return
        made = (self._directory / name).parent
        if made != self._directory:
            self._made[:0] = [p for p in (made, *made.parents) if not p.exists()]
            made.mkdir(parents=True, exist_ok=True)
        _append(self._file(name), calibration.read_bytes())

    def _discard(self) -> None:
        """Take away what was made, unless somebody else has put something there."""
        self.close()
        for path in self._made:
            with contextlib.suppress(OSError):
                path.rmdir() if path.is_dir() else path.unlink()


def _append(file: FileIO, data: bytes | bytearray) -> None:
    """All of it: a disk that is nearly full takes a part, and refuses the rest."""
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]


def _sync_directory(path: Path) -> None:
    with contextlib.suppress(OSError):  # not every file system can
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
