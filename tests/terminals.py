"""The text that a program draws on a pseudo-terminal."""

import contextlib
import os
import select
import time

WAIT_S = 60.0


def read_all(ours: int) -> str:
    """All that was written before the other end closed: one `read` may return a part of it."""
    drawn = bytearray()
    with contextlib.suppress(OSError):  # EIO: the other end has closed, and all has been read
        while part := os.read(ours, 65536):
            drawn += part
    os.close(ours)
    return drawn.decode()


def read_until(ours: int, text: str) -> str:
    """All that is written up to a part that has `text`."""
    drawn, end_s = "", time.monotonic() + WAIT_S
    while text not in drawn:
        assert select.select([ours], [], [], max(0.0, end_s - time.monotonic()))[0], drawn
        drawn += os.read(ours, 65536).decode(errors="replace")
    return drawn
