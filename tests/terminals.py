"""What a program drew on a pseudo-terminal, whole."""

import contextlib
import os


def read_all(ours: int) -> str:
    """All that was written before the other end closed: one `read` may return a part of it."""
    drawn = bytearray()
    with contextlib.suppress(OSError):  # EIO: the other end has closed, and all has been read
        while part := os.read(ours, 65536):
            drawn += part
    os.close(ours)
    return drawn.decode()
