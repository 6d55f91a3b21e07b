"""Writes a session as it comes: records are taken without waiting, and written by a thread.

The files are made when the first record comes, each of them anew: a file or a link of that name is
never written to. Files are only appended to, whole records at a time; the bytes of a serial line
come before the rows that date them. However a recording ends, `session.records` finds all but its
last moment. A disk that is slow or full is waited for, and costs records, which are counted;
another fault of it ends the recording, never the caller.
"""

import contextlib
import errno
import logging
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Self

from taxeld.errors import SetupError
from taxeld.source.session import (
    ABOUT,
    ARRAY,
    CONFIG,
    FRAMES,
    LINK,
    POSE_COLUMNS,
    POSES,
    SERIAL,
    SERIAL_COLUMNS,
    SERIAL_TIMES,
    VERSION,
    Item,
)
from taxeld_protocol.array import ArrayFrame, line_of
from taxeld_protocol.frames import Chunk, Frame, format_log_line

PAUSE_S = 0.25  # pause between two writings: short, so that none holds the interpreter for long
SYNC_S = 5.0  # time that a power cut may cost
CLOSE_S = 5.0  # time for the last writing
BATCH = 500  # records formatted and written at once
WAITING_BYTES = 16_000_000  # bytes that may wait for the disk: 10 s of a full bus
PASSING = (errno.ENOSPC, errno.EDQUOT, errno.EIO)  # faults of a disk that may end
RECORD_BYTES = 200  # memory of a record beside its data, roughly
PARTS = (SERIAL, SERIAL_TIMES, FRAMES, ARRAY, POSES)
COUNTED = ("frames", "chunks", "bytes", "poses")

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RecordCounters:
    """Counts of written and lost records, since start."""

    frames: int = 0  # of a bus, or of an array
    bytes: int = 0  # bytes of a serial line
    poses: int = 0
    dropped: int = 0  # records of any kind that the disk did not take, or not in time
    failed: bool = False  # the disk took no more, and the recording has ended


def headers(links: int) -> dict[str, str]:
    """The first line of each file that has one."""
    more = [LINK] if links > 1 else []
    return {
        ABOUT: f"version = {VERSION}\n",
        POSES: ",".join(POSE_COLUMNS + more) + "\n",
        SERIAL_TIMES: ",".join(SERIAL_COLUMNS + more) + "\n",
    }


def formatted(
    records: Iterable[tuple[Item, int]], written: Counter[str], links: int
) -> dict[str, bytearray]:
    """What the files get of records, each with the number of its link; `written` counts them."""
    parts = {name: bytearray() for name in PARTS}
    for item, link in records:
        column = f",{link}\n" if links > 1 else "\n"
        if isinstance(item, Frame):
            parts[FRAMES] += f"{format_log_line(item, f'can{link}')}\n".encode()
            written["frames"] += 1
        elif isinstance(item, ArrayFrame):
            parts[ARRAY] += f"{line_of(item)}\n".encode()
            written["frames"] += 1
        elif isinstance(item, Chunk):
            parts[SERIAL_TIMES] += f"{item.t:.6f},{written['bytes']}{column}".encode()
            parts[SERIAL] += item.data
            written["bytes"] += len(item.data)
            written["chunks"] += 1
        else:
            t, x, y, theta = item
            parts[POSES] += f"{t:.6f},{x!r},{y!r},{theta!r}{column}".encode()
            written["poses"] += 1
    return parts


class Recorder:
    """Writes a session directory while it is entered; nothing if no record comes."""

    def __init__(
        self,
        directory: Path,
        *,
        moves: bool,
        config: Path | None = None,
        calibration: Path | None = None,
        links: int = 1,
    ) -> None:
        """`moves`: whether a robot sends the sensor's pose. `config` is kept with the session,
        together with its `calibration` if that lies beside it.

        Raises:
            SetupError: the directory cannot be written to, or has a file of a session already.
        """
        self._directory, self._moves, self._links = directory, moves, links
        self._headers = headers(links)
        self._kept = _kept(config, calibration)
        _check_free(directory, [ABOUT, *PARTS, *self._kept])
        self._waiting: deque[tuple[Item, int]] = deque()
        self._came = self._refused = 0  # records taken so far, and records refused
        self._came_bytes = self._taken_bytes = 0  # bytes put by the caller, and taken
        self._written = Counter[str]()
        self._failed = self._is_full = False
        self._open: dict[str, FileIO] = {}  # made anew as they are first appended to
        self._closing = threading.Event()
        # a hanging disk must not keep the process from ending
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    @property
    def counters(self) -> RecordCounters:
        """The counts as far as written."""
        frames, chunks, size, poses = (self._written[name] for name in COUNTED)
        unwritten = self._came - frames - chunks - poses if self._failed else 0
        return RecordCounters(frames, size, poses, self._refused + unwritten, self._failed)

    def take(self, item: Item, link: int = 0) -> None:
        """Record a CAN frame of either direction, bytes of a serial line or an array's frame, with
        the first link of its source; or the pose in the world of a link's sensor."""
        if self._failed or self._came_bytes - self._taken_bytes > WAITING_BYTES:
            self._refused += 1
            return
        self._came += 1
        self._came_bytes += _size(item)
        self._waiting.append((item, link))

    @property
    def on_poses(self) -> list[Callable[[float, float, float, float], None]]:
        """What takes a pose (t, x, y, θ) of each link's sensor."""
        return [partial(self.pose, link=k) for k in range(self._links)]

    def pose(self, t: float, x: float, y: float, theta: float, link: int = 0) -> None:
        self.take((t, x, y, theta), link)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            self._fail(f"the disk did not take the last of it within {CLOSE_S:g} s")

    def _fail(self, reason: str) -> None:
        self._failed = True
        log.warning(
            "%s: the recording has ended (%s); it replays up to here", self._directory, reason
        )

    def _run(self) -> None:
        try:
            self._write_all()
        except OSError as error:
            self._fail(error.strerror or str(error))
            self._waiting.clear()
        for file in self._open.values():
            with contextlib.suppress(OSError):
                file.close()

    def _write_all(self) -> None:
        """Write records until the caller leaves. Raises OSError."""
        next_sync_s = time.monotonic()
        closing = False
        while not closing:
            closing = self._closing.wait(PAUSE_S)
            if self._waiting and not self._open:
                begin = {ABOUT: b"", **self._kept, **({POSES: b""} if self._moves else {})}
                for name, content in begin.items():
                    self._append(name, content)
            for _ in range(0, len(self._waiting), BATCH):
                batch = [self._waiting.popleft() for _ in range(min(BATCH, len(self._waiting)))]
                self._write(batch)
                self._taken_bytes += sum(_size(item) for item, _ in batch)
            if closing or time.monotonic() >= next_sync_s:
                self._sync()
                next_sync_s = time.monotonic() + SYNC_S
        if self._open:
            totals = {"dropped": self._refused, **{name: self._written[name] for name in COUNTED}}
            text = "".join(f"{name} = {count}\n" for name, count in totals.items())
            self._append(ABOUT, text.encode())
            self._sync()

    def _write(self, batch: list[tuple[Item, int]]) -> None:
        written = self._written.copy()
        parts = formatted(batch, written, self._links)
        if parts[SERIAL]:
            self._append(SERIAL_TIMES, b"")  # each line needs a file that dates it
        for name, data in parts.items():
            if data:
                self._append(name, data)
        self._written = written

    def _append(self, name: str, data: bytes | bytearray) -> None:
        """Append all of the data, after the header in a new file. Raises OSError."""
        if name not in self._open:
            self._open[name] = self._made(name)
            data = self._headers.get(name, "").encode() + data
        rest = memoryview(data)
        while rest:  # a nearly full disk takes a part, and then refuses the rest
            try:
                rest = rest[self._open[name].write(rest) :]
            except OSError as error:
                self._wait(error)
        if self._is_full:
            log.warning("%s: the recording goes on", self._directory)
        self._is_full = False

    def _made(self, name: str) -> FileIO:
        """A new file, once the disk has room for it. Raises OSError."""
        while True:
            try:
                self._directory.mkdir(parents=True, exist_ok=True)
                return FileIO(self._directory / name, "x")  # O_EXCL, which follows no link
            except OSError as error:
                self._wait(error)

    def _wait(self, error: OSError) -> None:
        """Wait a moment for a disk whose fault may pass. Raises the error where it may not, or when
        the recording is to end."""
        if error.errno not in PASSING:
            raise error
        if not self._is_full:
            log.warning("%s: the recording waits (%s)", self._directory, error.strerror)
        self._is_full = True
        if self._closing.wait(PAUSE_S):
            raise error

    def _sync(self) -> None:
        """Flush the files to the disk. Raises OSError."""
        for file in self._open.values():
            try:
                os.fsync(file.fileno())
            except OSError as error:
                self._wait(error)


def _size(item: Item) -> int:
    if isinstance(item, ArrayFrame):
        return RECORD_BYTES + 8 * len(item.counts)
    return RECORD_BYTES + (len(item.data) if isinstance(item, Frame | Chunk) else 0)


def _kept(config: Path | None, calibration: Path | None) -> dict[str, bytes]:
    """Files kept with a session: the configuration, and a calibration beside it. Raises
    SetupError."""
    try:
        kept = {} if config is None else {CONFIG: config.read_bytes()}
        is_beside = config and calibration and calibration.parent == config.parent
        # a daemon may run without a calibration file
        if calibration and is_beside and calibration.is_file():
            kept.setdefault(calibration.name, calibration.read_bytes())
    except OSError as error:
        raise SetupError(f"{error.filename or config}: cannot be read ({error.strerror})") from None
    return kept


def _check_free(directory: Path, names: list[str]) -> None:
    """Check that these files can be made in the directory. Raises SetupError."""
    try:
        there = next(path for path in (directory, *directory.parents) if path.exists())
        taken = [path for name in names if (path := directory / name).is_symlink() or path.exists()]
    except OSError as error:
        raise SetupError(f"{directory}: cannot be made ({error.strerror})") from None
    if taken:
        raise SetupError(f"{taken[0]}: is there already; name another directory for the recording")
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        raise SetupError(f"{directory}: cannot be made, as {there} cannot be written to")
