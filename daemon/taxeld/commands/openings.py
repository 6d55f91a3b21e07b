"""Whether a run could open its device and serve its endpoints, asked without opening any of them.

The lines equal the refusals of `taxeld run`: tests compare them.
"""

import contextlib
import errno
import os
import socket
import stat
from pathlib import Path

from taxeld.config import endpoints
from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source import opening
from taxeld.source.slcan_device import adapter_line

SYS_NET = Path("/sys/class/net")
LOCKS = Path("/proc/locks")
CAN_TYPE = "280"  # ARPHRD_CAN
IS_UP = 0x1  # IFF_UP
PROBE_S = 1.0


def device(source: SourceConfig) -> str:
    """The path of a source's serial line; empty for a CAN interface and for a session.

    Raises:
        SetupError: the text after the channel's @ is no line speed.
    """
    if source.kind == "serial":
        return source.channel
    if source.kind == "can" and source.interface == "slcan":
        return adapter_line(source.channel)[0]
    return ""


def absent(source: SourceConfig) -> str | None:
    """A line on why the source's device cannot be opened by anyone; None where it can."""
    try:
        where = device(source)
    except SetupError as error:  # the channel names no device
        return str(error)
    if where:
        return _unopened_line(where)
    if source.kind == "can" and source.interface == "socketcan":
        return _unopened_interface(source)
    return None


def taken(source: SourceConfig) -> str | None:
    """A line if another process has locked the serial line of a source that is not `absent`."""
    where = device(source)
    return str(opening.busy(where)) if where and _is_locked(where) else None


def down(source: SourceConfig) -> str | None:
    """A line on how to bring up a CAN interface that exists and is down; a run waits for that."""
    if source.kind != "can" or source.interface != "socketcan":
        return None
    with contextlib.suppress(OSError, ValueError):
        if not int((SYS_NET / source.channel / "flags").read_text(encoding="ascii"), 16) & IS_UP:
            return f"source.channel: {source.channel} is down; bring it up: {_bring_up(source)}"
    return None


def closed(endpoint: str, key: str) -> str | None:
    """A line on why nothing may be served at an ipc endpoint, even if it is free."""
    path = endpoints.ipc_path(endpoint)
    if path is None or path.parent == endpoints.own_directory():
        return None
    missing = endpoints.no_directory(endpoint)
    if missing:
        return f"{key}: {missing}"
    if os.path.lexists(path) and not path.is_socket():
        return f"{key}: {path} is no socket; remove it or name another endpoint"
    if not os.access(path.parent, os.W_OK | os.X_OK, effective_ids=True):
        denied = os.strerror(errno.EACCES)
        if os.path.lexists(path):
            return f"{key}: cannot take over {path} ({denied})"
        return (
            f"{key}: cannot bind {endpoint} ({denied}); "
            "is another daemon there? stop it or name another endpoint"
        )
    return None


def served(endpoint: str, key: str) -> str | None:
    """A line if an ipc endpoint is served already."""
    path = endpoints.ipc_path(endpoint)
    if path is None or not path.is_socket():
        return None
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(PROBE_S)
        try:
            probe.connect(str(path))
        except OSError:  # left behind, or closed to this user
            return None
    return f"{key}: another daemon serves {path}; stop it or name another endpoint"


def _unopened_line(where: str) -> str | None:
    try:
        mode = Path(where).stat().st_mode
    except OSError as error:
        return str(opening.unopened(where, error))
    number = 0
    if stat.S_ISDIR(mode):
        number = errno.EISDIR
    elif not os.access(where, os.R_OK | os.W_OK, effective_ids=True):
        number = errno.EACCES
    elif not stat.S_ISCHR(mode):
        number = errno.ENOTTY
    return str(opening.unopened(where, OSError(number, os.strerror(number)))) if number else None


def _unopened_interface(source: SourceConfig) -> str | None:
    name = source.channel
    place = SYS_NET / name
    if not place.exists():
        return f"source.channel: no CAN interface '{name}'; bring it up: {_bring_up(source)}"
    with contextlib.suppress(OSError):
        if (place / "type").read_text(encoding="ascii").strip() != CAN_TYPE:
            return f"source.channel: {name} is no CAN interface; 'ip link show type can' lists them"
    return None


def _bring_up(source: SourceConfig) -> str:
    return f"ip link set {source.channel} up type can bitrate {source.bitrate}"


def _is_locked(where: str) -> bool:
    """Whether a process holds a lock on a line, by the kernel's list."""
    try:
        node, locks = Path(where).stat(), LOCKS.read_text(encoding="ascii")
    except OSError:
        return False
    inode = f" {os.major(node.st_dev):02x}:{os.minor(node.st_dev):02x}:{node.st_ino} "
    return any("FLOCK" in line and inode in line for line in locks.splitlines())
