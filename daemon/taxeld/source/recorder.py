"""Writes a session as it comes: arrivals are taken without waiting, and written by a worker.

The files are made when the first arrival comes, each of them anew: a file or a link of that name is
never written to. They are only appended to. However a recording ends, `session.arrivals` finds all
but its last moment. A disk that is slow or full is waited for, and costs arrivals, which are
counted; another fault of it, or files that are removed, end the recording, never the caller.
"""

import contextlib
import errno
import logging
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Self

from taxeld.errors import SetupError
from taxeld.source.session import ARRIVALS, CONFIG, VERSION, Arrival, Head, Item, packed
from taxeld.worker import Job, Worker
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.frames import Chunk, Frame

PAUSE_S = 0.25  # pause between two writings: short, so that none holds the interpreter for long
SYNC_S = 5.0  # time that a power cut may cost
CLOSE_S = 5.0  # time for the last writing
BATCH = 500  # arrivals packed and written at once
WAITING_BYTES = 16_000_000  # bytes that may wait for the disk: 10 s of a full bus
PASSING = (errno.ENOSPC, errno.EDQUOT, errno.EIO)  # faults of a disk that may end
RECORD_BYTES = 200  # memory of an arrival beside its data, roughly

log = logging.getLogger(__name__)


def new_file(path: Path) -> FileIO:
    """Open a file where none is; a link is not followed (O_EXCL)."""
    return FileIO(path, "x")


class Recorder:
    """Writes a session directory while it is entered; nothing if nothing comes."""

    def __init__(
        self,
        directory: Path,
        *,
        moves: bool,
        modules: Mapping[int, tuple[tuple[int, ...], ...]] | None = None,
        config: Path | None = None,
        calibration: Path | None = None,
        worker: Callable[[str, Job, float], Worker] = Worker,
        open_new: Callable[[Path], FileIO] = new_file,
    ) -> None:
        """`moves` and `modules`: as of Head. `config` is kept with the session, together with its
        `calibration` if that lies beside it. `open_new`: as `new_file`.

        Raises:
            SetupError: the directory cannot be written to, or has a file of a session already.
        """
        self._directory, self._head = directory, Head(VERSION, moves, dict(modules or {}))
        # what each file is to get, in this order, once something has come
        self._rest = _kept(config, calibration) | {ARRIVALS: bytearray()}
        _check_free(directory, self._rest)
        self._open: dict[str, FileIO] = {}
        self._waiting: deque[Arrival] = deque()
        self._came = self._refused = 0  # arrivals taken so far, and refused
        self._came_bytes = self._taken_bytes = 0  # bytes put by the caller, and taken
        self.written = self._packed = 0  # arrivals on the disk, and with those on their way to it
        self.failed, self._fault = False, ""  # whether it has ended; for what it waits
        self._next_sync_s = -math.inf
        self._start, self._open_new = worker, open_new

    @property
    def dropped(self) -> int:
        """Arrivals that the disk did not take, or not in time."""
        return self._refused + (self._came - self.written) * self.failed

    def take(self, item: Item, link: int = 0, t: float | None = None) -> None:
        """Record what has come, with the number of a pose's link or of the first on a source;
        `t`: when, where the item's own time is another's."""
        if self.failed or self._came_bytes - self._taken_bytes > WAITING_BYTES:
            self._refused += 1
            return
        self._came += 1
        self._came_bytes += _size(item)
        self._waiting.append(Arrival(item.t if t is None else t, link, item))

    def __enter__(self) -> Self:
        self._worker = self._start("recorder", self._turn, PAUSE_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.give(partial(self._turn, closing=True))
        if not self._worker.close(CLOSE_S):
            self._fail(f"the disk did not take the last of it within {CLOSE_S:g} s")

    def _fail(self, reason: str) -> None:
        self.failed = True
        log.warning("%s: the recording has ended (%s)", self._directory, reason)

    def _turn(self, *, closing: bool = False) -> None:
        """Write what has come, unless the recording has ended."""
        try:
            if not self.failed:
                self._sync(closing=closing)
        except Exception as error:  # a fault of ours is to be seen as well
            self._fail(getattr(error, "strerror", None) or repr(error))
            self._waiting.clear()
        for file in self._open.values() if closing or self.failed else ():
            with contextlib.suppress(OSError):
                file.close()

    def _sync(self, *, closing: bool) -> None:
        """Write what has come, and now and then have the disk keep it. Raises OSError."""
        fault = ""
        try:
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

    def _write(self) -> None:
        """Write what has come. Raises OSError; then the next call goes on with the rest."""
        if not all(os.fstat(file.fileno()).st_nlink for file in self._open.values()):
            raise OSError(errno.ENOENT, "its files are gone")
        self._flush()
        while self._waiting:
            batch = [self._waiting.popleft() for _ in range(min(BATCH, len(self._waiting)))]
            self._taken_bytes += sum(_size(arrival.item) for arrival in batch)
            first = [] if self._packed else [Arrival(batch[0].t, 0, self._head)]
            self._rest[ARRIVALS] += b"".join(map(packed, first + batch))
            self._packed += len(batch)
            self._flush()

    def _flush(self) -> None:
        """Write the rest of what was packed. Raises OSError."""
        for name, rest in self._rest.items() if self._packed else ():
            if name not in self._open:
                self._directory.mkdir(parents=True, exist_ok=True)
                self._open[name] = self._open_new(self._directory / name)
            while rest:  # a nearly full disk takes a part, and refuses the rest
                del rest[: self._open[name].write(rest)]
        self.written = self._packed


def _size(item: object) -> int:
    if isinstance(item, ArrayFrame):
        return RECORD_BYTES + 8 * len(item.counts)
    return RECORD_BYTES + (len(item.data) if isinstance(item, Frame | Chunk) else 0)


def _kept(config: Path | None, calibration: Path | None) -> dict[str, bytearray]:
    """Files kept with a session: the configuration, and a calibration beside it. Raises
    SetupError."""
    try:
        kept = {} if config is None else {CONFIG: bytearray(config.read_bytes())}
        is_beside = config and calibration and calibration.parent == config.parent
        # a daemon may run without a calibration file
        if calibration and is_beside and calibration.is_file():
            kept.setdefault(calibration.name, bytearray(calibration.read_bytes()))
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
