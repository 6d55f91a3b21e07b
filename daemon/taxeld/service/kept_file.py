"""A file of what is kept over restarts: read once, and written seldom, by a thread of its own.

It is written beside, synced and then renamed, so that a power cut leaves the old one or the new
one, whole. A fault of the disk or of the file is warned of once.
"""

import logging
import os
import threading
from collections.abc import Callable
from pathlib import Path

from taxeld.config.file import opened

FUTURE_S = 3600.0  # a time farther ahead was stored by a wrong clock, or is read by one
CLOSE_S = 2.0  # time that the last writing may take

log = logging.getLogger(__name__)


class KeptFile:
    """One file; nothing but `close` waits for the disk."""

    def __init__(self, path: Path, most: int) -> None:
        """`most`: bytes of a file that is read."""
        self._path, self._most = path, most
        self._failed = False
        self._writer: threading.Thread | None = None

    def read(self, take: Callable[[bytes], None], cost: str) -> None:
        """Have the content taken, if there is any. Where it cannot be, which `take` says by a
        ValueError, that is warned of, with its `cost`."""
        try:
            with opened(self._path, self._most) as file:
                take(file.read(self._most))
        except FileNotFoundError:
            return
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            log.warning("%s: not used, %s; %s", self._path, reason, cost)

    @property
    def is_busy(self) -> bool:
        """Whether the disk has not taken the last content yet."""
        return self._writer is not None and self._writer.is_alive()

    def write(self, make: Callable[[], bytes]) -> None:
        """Write what is made, unless the disk is busy."""
        if not self.is_busy:
            # a disk that hangs must not keep the daemon from ending
            self._writer = threading.Thread(
                target=lambda: self._write(make()), name=self._path.name, daemon=True
            )
            self._writer.start()

    def close(self, make: Callable[[], bytes] | None) -> None:
        """Write the last content, if there is any, unless the disk does not take it in time."""
        self._wait()
        if make is not None:
            self.write(make)
            self._wait()

    def _wait(self) -> None:
        if self._writer is not None:
            self._writer.join(CLOSE_S)

    def _write(self, data: bytes) -> None:
        """In place of the file, or of a link, which is not followed."""
        beside = self._path.with_suffix(".new")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            beside.unlink(missing_ok=True)
            with beside.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self._path)
        except OSError as error:
            if not self._failed:
                log.warning("%s: not written (%s)", self._path, error.strerror)
            self._failed = True
