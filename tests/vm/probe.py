"""Run in the service's place, under all that the unit forbids: what it may do, as JSON."""

import ctypes
import errno
import json
import mmap
import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path

MCL_CURRENT, CLONE_NEWUSER = 1, 0x10000000
LIBC = ctypes.CDLL(None, use_errno=True)


def libc(name: str, *args: int) -> None:
    if getattr(LIBC, name)(*args):
        raise OSError(ctypes.get_errno(), name)


def connect(host: str) -> None:
    with socket.create_connection((host, int(sys.argv[1])), timeout=5.0):
        pass


def open_device(path: str) -> None:
    os.close(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY))


def status(key: str) -> str:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(line.split()[1] for line in lines if line.startswith(key))


def outcome(act: Callable[[], object]) -> str:
    try:
        act()
    except TimeoutError:
        return "ETIMEDOUT"
    except OSError as error:
        return errno.errorcode[error.errno or errno.EIO]
    return "may"


ACTS: dict[str, Callable[[], object]] = {
    "a FIFO thread": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10)),
    "locked memory": lambda: libc("mlockall", MCL_CURRENT),
    "connect to loopback": lambda: connect("127.0.0.1"),
    "connect beyond": lambda: connect("192.0.2.1"),
    "a CAN socket": lambda: socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close(),
    "a packet socket": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW).close(),
    "a USB serial line": lambda: open_device("/dev/ttyUSB0"),
    "a disk": lambda: open_device("/dev/open_disk"),
    "write to the system": lambda: Path("/srv/open/file").write_text("", encoding="ascii"),
    "write its state": lambda: Path(os.environ["STATE_DIRECTORY"], "file").touch(),
    "memory both writable and executable": lambda: mmap.mmap(
        -1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC
    ),
    "a user namespace": lambda: libc("unshare", CLONE_NEWUSER),
    # these the system call filter alone forbids
    "another niceness": lambda: os.setpriority(os.PRIO_PROCESS, 0, 5),
    "another processor": lambda: os.sched_setaffinity(0, {0}),
    "see other processes": lambda: Path("/proc/1").stat(),
}

if __name__ == "__main__":
    found = {name: outcome(act) for name, act in ACTS.items()}
    found |= {"uid": str(os.getuid()), "capabilities": status("CapEff:")}
    print(json.dumps(found))
