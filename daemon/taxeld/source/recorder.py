"""Writes a session as it comes: records are taken without waiting, and written by a worker.

The files are made when the first record comes, each of them anew: a file or a link of that name is
never written to. Files are only appended to, whole records at a time; the bytes of a serial line
come before the rows that date them. However a recording ends, `session.records` finds all but its
last moment. A disk that is slow or full is waited for, and costs records, which are counted;
another fault of it, or files that are removed, end the recording, never the caller.
"""

import contextlib
import errno
import logging
import math
import os
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable
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
from taxeld.worker import Worker
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


def headers(links: int) -> dict[str, bytearray]:
    """How each file begins."""
    more = [LINK] if links > 1 else []
    first = {
        ABOUT: f"version = {VERSION}\n",
        POSES: ",".join(POSE_COLUMNS + more) + "\n",
        SERIAL_TIMES: ",".join(SERIAL_COLUMNS + more) + "\n",
    }
    return {name: bytearray(first.get(name, "").encode()) for name in (ABOUT, *PARTS)}


def formatted(
    records: Iterable[tuple[Item, int]], written: Counter[str], links: int
) -> dict[str, bytearray]:
    """What the files get of records, each with the number of its link; `written` counts them."""
    parts = defaultdict[str, bytearray](bytearray)
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
        self._directory, self._links = directory, links
        kept = _kept(config, calibration)
        # what each file is to get, in this order, once it has begun
        self._rest = headers(links) | {name: bytearray(data) for name, data in kept.items()}
        _check_free(directory, self._rest)
        self._first = {ABOUT, *kept, *([POSES] if moves else [])}  # begin with the first record
        self._begun = set[str]()
        self._open: dict[str, FileIO] = {}
        self._waiting: deque[tuple[Item, int]] = deque()
        self._came = self._refused = 0  # records taken so far, and records refused
        self._came_bytes = self._taken_bytes = 0  # bytes put by the caller, and taken
        self.failed, self._fault = False, ""  # whether it has ended; for what it waits
        self.written = Counter[str]()  # frames, chunks and bytes of a serial line, poses
        self._formatted = Counter[str]()  # the same, but for what the disk has not taken yet
        self._next_sync_s = -math.inf
        self._closing = threading.Event()

    @property
    def dropped(self) -> int:
        """Records of any kind that the disk did not take, or not in time."""
        frames, chunks, _, poses = (self.written[name] for name in COUNTED)
        return self._refused + (self._came - frames - chunks - poses) * self.failed

    def take(self, item: Item, link: int = 0) -> None:
        """Record a CAN frame of either direction, bytes of a serial line or an array's frame, with
        the first link of its source; or the pose in the world of a link's sensor."""
        if self.failed or self._came_bytes - self._taken_bytes > WAITING_BYTES:
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
        self._worker = Worker("recorder")
        self._worker.give(self._run)
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        if not self._worker.close(CLOSE_S):
            self._fail(f"the disk did not take the last of it within {CLOSE_S:g} s")

    def _fail(self, reason: str) -> None:
        self.failed = True
        log.warning("%s: the recording has ended (%s)", self._directory, reason)

    def _run(self) -> None:
        try:
            while not self._turn():
                pass
        except Exception as error:  # a fault of ours is to be seen as well
            self._fail(getattr(error, "strerror", None) or repr(error))
            self._waiting.clear()
        for file in self._open.values():
            with contextlib.suppress(OSError):
                file.close()

    def _turn(self) -> bool:
        """Wait a moment, and write what has come; → whether that was the last. Raises OSError."""
        closing, fault = self._closing.wait(PAUSE_S), ""
        try:
            self._write()
            if closing and self._open:
                totals = {"dropped": self._refused, **{k: self.written[k] for k in COUNTED}}
                self._rest[ABOUT] += "".join(f"{k} = {n}\n" for k, n in totals.items()).encode()
                self._write()
            if closing or time.monotonic() >= self._next_sync_s:
                for file in self._open.values():
                    os.fsync(file.fileno())
                self._next_sync_s = time.monotonic() + SYNC_S
        except OSError as error:
            if closing or error.errno not in PASSING:
                raise
            fault = f"waits ({error.strerror})"
        if fault != self._fault:
            log.warning("%s: the recording %s", self._directory, fault or "goes on")
        self._fault = fault
        return closing

    def _write(self) -> None:
        """Write what has come. Raises OSError; then the next call goes on with the rest."""
        if not all(os.fstat(file.fileno()).st_nlink for file in self._open.values()):
            raise OSError(errno.ENOENT, "its files are gone")
        self._flush()
        while self._waiting:
            batch = [self._waiting.popleft() for _ in range(min(BATCH, len(self._waiting)))]
            self._taken_bytes += sum(_size(item) for item, _ in batch)
            parts = formatted(batch, self._formatted, self._links)
            self._begun |= self._first.union(parts)
            for name, data in parts.items():
                self._rest[name] += data
            self._flush()

    def _flush(self) -> None:
        """Write the rest of what was formatted. Raises OSError."""
        for name in self._begun - self._open.keys():
            self._directory.mkdir(parents=True, exist_ok=True)
            # O_EXCL, which follows no link
            self._open[name] = FileIO(self._directory / name, "x")
        for name in (name for name in self._rest if name in self._open):
            while self._rest[name]:  # a nearly full disk takes a part, and refuses the rest
                del self._rest[name][: self._open[name].write(self._rest[name])]
        self.written = self._formatted.copy()


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


def _check_free(directory: Path, names: Iterable[str]) -> None:
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
