"""Peers that have ZeroMQ gather memory without end.

ZeroMQ keeps the frames of a message until the last of them has come, however many they are, and
says so to nobody. It shows in the memory of the process; and who is sending meanwhile shows in the
kernel, as subscribers send nothing, and clients little.
"""

import ctypes
import fcntl
import math
import os
import re
import socket
import struct
import termios
import threading
from collections.abc import Iterable
from pathlib import Path

from taxeld.config import endpoints
from taxeld.stream.sockets import borrowed

LOOK_S = 0.01
STEP_BYTES = 1 << 20  # of the process: a look at that is cheap, and at what is allocated is not
GROWTH_BYTES = 32 << 20  # of what is allocated: by more, and whoever is sending is hung up on
OWN_S = 1.0  # where nobody has been sending for so long, it is the daemon's own
TRIM_S = 1.0  # after that ZeroMQ has let go of what they sent, and the kernel gets it back
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
LOCKED = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT: as `service.realtime` has it
STATUS = Path("/proc/self/status")
DESCRIPTORS = Path("/proc/self/fd")


class Hoard:
    """The memory of this process, and the peers of the endpoints that it serves."""

    def __init__(self, served: Iterable[str]) -> None:
        self.hung_up = 0  # peers
        self._places = {_place(endpoint) for endpoint in served}
        self._file = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
        self._resident = self._least = math.inf  # then, and the least that has been allocated
        self._own_s = math.inf
        self._next_s, self._trim_s = -math.inf, math.inf

    def look(self, now_s: float) -> None:
        """Hang up on those who hoard; `now_s` is monotonic."""
        if now_s < self._next_s:
            return
        self._next_s = now_s + LOOK_S
        if now_s >= self._trim_s:
            self._trim_s = math.inf
            threading.Thread(target=_give_back, daemon=True).start()
        resident = int(os.pread(self._file, 100, 0).split()[1]) * PAGE_BYTES
        if resident < self._resident + STEP_BYTES and self._resident < math.inf:
            self._resident = min(self._resident, resident)
            return
        allocated = _allocated() or resident
        self._least = min(self._least, allocated)
        if allocated < self._least + GROWTH_BYTES:
            self._resident, self._own_s = resident, math.inf
            return
        found = sum(map(self._hang_up, _descriptors()))
        self.hung_up += found
        if found:
            self._own_s = math.inf
            self._trim_s = min(self._trim_s, now_s + TRIM_S)
        self._own_s = min(self._own_s, now_s + OWN_S)
        if now_s >= self._own_s:
            self._least = allocated

    def close(self) -> None:
        os.close(self._file)

    def _hang_up(self, number: int) -> bool:
        """Whether the descriptor is a connection to one of our endpoints that has more to read."""
        try:
            with borrowed(number) as connection:
                name = connection.getsockname()
                if (name if isinstance(name, str) else name[1:2]) not in self._places:
                    return False
                unread = fcntl.ioctl(connection, termios.FIONREAD, bytes(4))
                if not struct.unpack("i", unread)[0]:
                    return False
                connection.shutdown(socket.SHUT_RDWR)
        except OSError:  # no socket, one that listens, or none any more
            return False
        return True


class _Allocated(ctypes.Structure):
    """What `mallinfo2` of the GNU C library answers, from its version 2.33 on."""

    _fields_ = (
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd")),
        *((name, ctypes.c_size_t) for name in ("usmblks", "fsmblks", "uordblks", "fordblks")),
        ("keepcost", ctypes.c_size_t),
    )


def _allocated() -> int:
    """Bytes that are in use, without those that are free and the process's still; 0 if unknown."""
    ask = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if ask is None:
        return 0
    ask.restype = _Allocated
    told = ask()
    return int(told.uordblks + told.hblkhd)


def _give_back() -> None:
    """What is free goes back to the kernel, which takes no memory that is locked: not meanwhile."""
    libc = ctypes.CDLL(None)
    locked = not re.search(r"^VmLck:\s+0 kB", STATUS.read_text("ascii"), re.MULTILINE)
    if locked:
        libc.munlockall()
    libc.malloc_trim(0)
    if locked:
        libc.mlockall(LOCKED)


def _descriptors() -> list[int]:
    """Of this process; none where there is none left to look with."""
    try:
        return [int(path.name) for path in DESCRIPTORS.iterdir()]
    except OSError:
        return []


def _place(endpoint: str) -> object:
    """Of an endpoint, what the kernel calls it: a path, or a port alone."""
    path = endpoints.ipc_path(endpoint)
    return str(path) if path is not None else (int(endpoint.rpartition(":")[2]),)
