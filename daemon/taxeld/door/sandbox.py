"""What the door may do: limits, so that the kernel ends the door and nothing else; and a sandbox of
Landlock (Linux 5.13) without devices, states, recordings and keys.

To be entered after what must be read has been read, and before ZeroMQ has started its threads.
"""

import contextlib
import ctypes
import os
import resource
import struct
from collections.abc import Iterable
from pathlib import Path

import zmq

MEMORY_BYTES = 192 << 20  # data of the process, stacks included
DESCRIPTORS = 16_384  # without one left ZeroMQ ends the process

CREATE_RULESET, ADD_RULE, RESTRICT_SELF = (
    444,
    445,
    446,
)  # landlock's system calls, on all processors
VERSION = 1
BENEATH, PORT = 1, 2  # kinds of rules
READ_FILE, READ_DIR, REMOVE_FILE, MAKE_SOCK = 1 << 2, 1 << 3, 1 << 5, 1 << 9
BIND_TCP, CONNECT_TCP = 1 << 0, 1 << 1
FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15}  # how many there are, by version; 16 from 5 on
PORTS_FROM, SCOPES_FROM = 4, 6
SCOPES = 0b11  # abstract sockets, and signals, of processes outside
PR_SET_NO_NEW_PRIVS = 38
# The C library looks here for the names of hosts
NAMES = (
    *("/etc/hosts", "/etc/host.conf", "/etc/nsswitch.conf", "/etc/resolv.conf", "/etc/gai.conf"),
    *("/run/systemd/resolve", "/lib", "/usr/lib", "/lib64"),
)
DNS = 53
PYTHON = (Path(os.__file__).parent, Path(zmq.__file__).parents[1])  # for what is imported late


def limit() -> None:
    """Bounds on memory, descriptors and files."""
    for what, most in (
        (resource.RLIMIT_DATA, MEMORY_BYTES),
        (resource.RLIMIT_NOFILE, DESCRIPTORS),
        (resource.RLIMIT_MEMLOCK, 0),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(what)[1]
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (least, least))


def start_no_more() -> None:
    """No further thread or process; of root the kernel does not ask this."""
    resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))


def confine(directories: Iterable[Path], binds: Iterable[int], connects: Iterable[int]) -> bool:
    """From now on only socket files in the directories are made and removed, and only TCP ports of
    these numbers are bound and connected to; → whether the kernel can."""
    libc = ctypes.CDLL(None, use_errno=True)
    version = libc.syscall(CREATE_RULESET, None, ctypes.c_size_t(0), VERSION)
    if version < 1:
        return False
    rights = (1 << FILE_RIGHTS.get(version, 16)) - 1
    ports = BIND_TCP | CONNECT_TCP if version >= PORTS_FROM else 0
    scopes = SCOPES if version >= SCOPES_FROM else 0
    fields = [rights, ports, scopes][: 1 + (version >= PORTS_FROM) + (version >= SCOPES_FROM)]
    attributes = struct.pack(f"={len(fields)}Q", *fields)
    rules = libc.syscall(CREATE_RULESET, attributes, ctypes.c_size_t(len(attributes)), 0)
    if rules < 0:
        return False
    try:
        for place in directories:
            _allow_beneath(libc, rules, place, MAKE_SOCK | REMOVE_FILE)
        for place in (*map(Path, NAMES), *PYTHON):
            _allow_beneath(libc, rules, place, READ_FILE | READ_DIR)
        if ports:
            for right, numbers in ((BIND_TCP, binds), (CONNECT_TCP, (*connects, DNS))):
                for number in numbers:
                    rule = struct.pack("=QQ", right, number)
                    libc.syscall(ADD_RULE, rules, PORT, rule, 0)
        if libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
            return False
        return bool(libc.syscall(RESTRICT_SELF, rules, 0) == 0)
    finally:
        os.close(rules)


def _allow_beneath(libc: ctypes.CDLL, rules: int, place: Path, rights: int) -> None:
    """A place that is not there, or of a file for which a right has no meaning, is left out."""
    with contextlib.suppress(OSError):
        if not place.is_dir():
            rights &= READ_FILE
        number = os.open(place, os.O_PATH | os.O_CLOEXEC)
        try:
            libc.syscall(ADD_RULE, rules, BENEATH, struct.pack("=Qi", rights, number), 0)
        finally:
            os.close(number)
