"""How files are read: regular ones alone, and whole ones up to a bound."""

import errno
from pathlib import Path
from typing import BinaryIO

LARGEST = 64_000_000  # bytes: of a scene, of a sampler; a wrong path may name a disk's image


def opened(path: Path) -> BinaryIO:
    """A regular file opened for reading. Other kinds are refused: a pipe or a device could keep its
    reader for ever.

    Raises:
        OSError: it is not regular, or cannot be opened; `strerror` says why.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return path.open("rb")


def read(path: Path, most: int = LARGEST) -> bytes:
    """The content of a file of at most `most` bytes. Raises OSError, as `opened`."""
    with opened(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it is larger than {most} bytes", str(path))
    return data
