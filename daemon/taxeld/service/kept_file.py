"""A file of arrays that is kept over restarts: numpy's own, without pickle.

It is read once; the zip's checksums say whether it is whole. One thread writes it, beside, synced
and then renamed, so that a power cut leaves the old file or the new one.
"""

import io
import logging
import os
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taxeld import files

CLOSE_S = 4.0  # time that the last two writings may take

Arrays = dict[str, NDArray[Any]]
log = logging.getLogger(__name__)


class KeptFile:
    """The file and its writer; nothing but `close` waits for the disk."""

    def __init__(self, path: Path) -> None:
        """The thread starts here, before the loop takes a priority that it would inherit."""
        self.path = path
        self._failed = False
        self._next: Callable[[], Arrays] | None = None  # until it is written
        self._last: Callable[[], Arrays | None] | None = None
        self._wake = threading.Event()
        # a disk that hangs must not keep the daemon from ending
        self._writer = threading.Thread(target=self._run, name=path.name, daemon=True)
        self._writer.start()

    def read(self) -> Arrays:
        """The content; {} where there is none, or none that can be used, which is warned of."""
        try:
            data = io.BytesIO(files.read(self.path))
            with zipfile.ZipFile(data) as whole:
                if whole.testzip() is not None:
                    raise ValueError
            data.seek(0)
            with np.load(data, allow_pickle=False) as arrays:
                return dict(arrays)
        except FileNotFoundError:
            return {}
        except OSError as error:
            self.warn(error.strerror or str(error))
        except Exception:  # exceptions of zip, zlib and numpy's headers share no base
            self.warn("it is damaged")
        return {}

    def warn(self, reason: str) -> None:
        """Say why the content, or a part of it, is not used."""
        log.warning("%s: not used, %s", self.path, reason)

    @property
    def is_busy(self) -> bool:
        """Whether the disk has not taken the last content yet."""
        return self._next is not None

    def write(self, make: Callable[[], Arrays]) -> None:
        """Have the content that `make` makes written, unless the disk is busy. The thread calls
        `make`, so that the caller does not wait for it."""
        if not self.is_busy:
            self._next = make
            self._wake.set()

    def close(self, make: Callable[[], Arrays | None]) -> None:
        """Write the last content, if there is any, unless the disk does not take it in time."""
        self._last = make
        self._wake.set()
        self._writer.join(CLOSE_S)

    def _run(self) -> None:
        while self._last is None:
            self._wake.wait()
            self._wake.clear()
            if self._next is not None:
                self._save(self._next())
                self._next = None
        if (last := self._last()) is not None:
            self._save(last)

    def _save(self, arrays: Arrays) -> None:
        """In place of the file, or of a link, which is not followed."""
        beside = self.path.with_suffix(".new")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            beside.unlink(missing_ok=True)
            with beside.open("xb") as file:
                np.savez(file, allow_pickle=False, **arrays)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self.path)
        except OSError as error:
            if not self._failed:
                log.warning("%s: not written (%s)", self.path, error.strerror)
            self._failed = True
