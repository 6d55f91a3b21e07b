"""Who has a serial line: it is ours alone while we have it, and whose it is when we cannot have it.

A lock (flock) keeps out programs that ask for one, as this one does; TIOCEXCL has the kernel keep
out all others but root's.
"""

import contextlib
import fcntl
import os
import re
import termios
from collections.abc import Iterator
from pathlib import Path

PROC = Path("/proc")
TIOCGEXCL = 0x80045440  # whether a line is exclusive: missing in `termios`
_LOCK = re.compile(r"^\d+: FLOCK .* (\d+) ([0-9a-f]+):([0-9a-f]+):(\d+) ", re.MULTILINE)


def claim(fd: int, device: str) -> bool:
    """Make an open line, that we have locked, ours alone; → whether it is no other's already.

    Only root comes so far on a line that is. Exclusiveness without a holder is what one left that
    died, on a line that something else keeps open.
    """
    if _is_exclusive(fd) and next(_with_it_open(device), None) is not None:
        return False
    fcntl.ioctl(fd, termios.TIOCEXCL)
    return True


def release(fd: int) -> None:
    """For a line that something else keeps open: else the kernel does it when it is closed."""
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, termios.TIOCNXCL)


def holder(device: str) -> str:
    """Who has a device, as far as that can be known: `pid 12, taxeld`; empty where it cannot.

    Anybody may read who holds a lock, but only what one's own user has open.
    """
    pid = _with_lock(device) or next(_with_it_open(device), 0)
    if not pid:
        return ""
    try:
        return f"pid {pid}, {(PROC / str(pid) / 'comm').read_text(errors='replace').strip()}"
    except OSError:  # another user's, hidden
        return f"pid {pid}"


def _is_exclusive(fd: int) -> bool:
    try:
        return any(fcntl.ioctl(fd, TIOCGEXCL, bytes(4)))
    except OSError:  # a kernel, or a line, that cannot say so
        return False


def _with_lock(device: str) -> int:
    """The process that has locked a device; 0 where none is known."""
    try:
        node = Path(device).stat()
        locks = (PROC / "locks").read_text()
    except OSError:
        return 0
    wanted = os.major(node.st_dev), os.minor(node.st_dev), node.st_ino
    for pid, major, minor, inode in _LOCK.findall(locks):
        if (int(major, 16), int(minor, 16), int(inode)) == wanted:
            return int(pid)
    return 0


def _with_it_open(device: str) -> Iterator[int]:
    """The other processes that have a device open, among those we may look into."""
    try:
        wanted = Path(device).stat().st_rdev
    except OSError:
        return
    for process in PROC.glob("[0-9]*"):
        if wanted and int(process.name) != os.getpid() and wanted in _open_devices(process):
            yield int(process.name)


def _open_devices(process: Path) -> Iterator[int]:
    try:
        for file in (process / "fd").iterdir():
            with contextlib.suppress(OSError):
                yield file.stat().st_rdev
    except OSError:  # another user's, or gone
        return
