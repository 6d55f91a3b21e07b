"""Descriptors that are kept for the device, so that it can be opened again whoever else takes some.

Drivers wait by select(2), which takes no descriptor from 1024 on: where many clients are connected,
the next free one may lie beyond that, or there may be none.
"""

import contextlib
import os
from collections.abc import Iterator

KEPT = 8  # pyserial opens five
SELECT_MAX = 1024  # FD_SETSIZE


class Reserve:
    """Low descriptors that nothing else can take."""

    def __init__(self) -> None:
        self._kept: list[int] = []
        self._fill()

    @contextlib.contextmanager
    def lent(self) -> Iterator[None]:
        """While something is opened, the descriptors are free for it."""
        self.close()
        try:
            yield
        finally:
            self._fill()

    def close(self) -> None:
        while self._kept:
            os.close(self._kept.pop())

    def _fill(self) -> None:
        with contextlib.suppress(OSError):  # there are no more: what is kept is better than nothing
            while len(self._kept) < KEPT:
                kept = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
                if kept >= SELECT_MAX:
                    os.close(kept)
                    return
                self._kept.append(kept)
