"""The files of a bundle, whole and as they were when it was built.

`bundle.json` names the SHA-256 of each file beside it. A file is read once: what was compared is
what is parsed.
"""

import hashlib
from pathlib import Path

from taxeld.errors import SetupError, one_line

MAX_BYTES = 64 << 20  # a hundred times the largest file of a shipped bundle
MAX_REASON = 200  # characters


def read(path: Path) -> bytes:
    """An ordinary file's content.

    Raises:
        SetupError: it is missing, unreadable, too large, or something else than a file.
    """
    try:
        if not path.is_file():
            raise SetupError(f"{path}: no such file; build the bundle again")
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise SetupError(f"{path}: unreadable ({error.strerror})") from None
    if len(data) > MAX_BYTES:
        raise SetupError(f"{path}: is larger than {MAX_BYTES >> 20} MiB; build the bundle again")
    return data


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def unbroken(path: Path, digests: dict[str, str]) -> dict[str, bytes]:
    """The content of the files {name: SHA-256} in a directory.

    Raises:
        SetupError: one is missing, or is not what it was.
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
    """What a parser of another package said, as a part of one line."""
    lines = str(error).splitlines() or [type(error).__name__]
    return one_line(lines[0][:MAX_REASON])
