"""A disk of its own, which can be full or read-only."""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest


class Disk:
    """A directory on a tmpfs, where one may be mounted; else tests of what it lacks are skipped."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.is_own = self._mount("-t", "tmpfs", "-o", "size=4m", "tmpfs")

    def fill(self) -> None:
        if not self.is_own:
            pytest.skip("a disk of its own needs root")
        with contextlib.suppress(OSError), (self.place / "ballast").open("wb", 0) as file:
            while file.write(bytes(4096)):
                pass

    def lock(self) -> None:
        """Make it read-only."""
        if not self._mount("-o", "remount,ro"):
            pytest.skip("a disk of its own needs root")

    def free(self) -> None:
        """Take back `fill` and `lock`."""
        self._mount("-o", "remount,rw")
        (self.place / "ballast").unlink(missing_ok=True)

    def _mount(self, *how: str) -> bool:
        command = ["mount", *how, self.place]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0


@contextlib.contextmanager
def disk(place: Path) -> Iterator[Disk]:
    """Meanwhile a new directory is a disk."""
    place.mkdir()
    made = Disk(place)
    try:
        yield made
    finally:
        subprocess.run(["umount", "--lazy", place], capture_output=True, check=made.is_own)
