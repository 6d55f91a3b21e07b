"""The files of a bundle, checked against the SHA-256 that `bundle.json` names.

A file is read once: the compared bytes are the ones that are parsed.
"""

import hashlib
from pathlib import Path

from taxeld.errors import SetupError


def read(path: Path) -> bytes:
    """Raises SetupError where the file is missing or unreadable."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise SetupError(f"{path}: {error.strerror}; build the bundle again") from None


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def unbroken(path: Path, digests: dict[str, str]) -> dict[str, bytes]:
    """The content of the files {name: SHA-256} in a directory.

    Raises:
        SetupError: one is missing, or has another digest.
    """
    files = {name: read(path / name) for name in digests}
    for name, data in files.items():
        if digest(data) != digests[name]:
            raise SetupError(
                f"{path / name}: is damaged or was changed: its SHA-256 is not that of "
                "bundle.json; copy or build the bundle again"
            )
    return files


def reason(error: Exception) -> str:
    """A parser's message, as a part of one line."""
    return str(error).partition("\n")[0] or type(error).__name__
