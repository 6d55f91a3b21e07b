"""Endpoints by their text: what may be bound or asked plainly, and what takes keys.

Names other than `localhost` are not looked up: where they lead may change after the check.
`/run/taxeld` is the service's; where it is not open to a user, `$XDG_RUNTIME_DIR/taxeld` stands for
it.
"""

import ipaddress
import os
from pathlib import Path

IPC = "ipc://"
TCP = "tcp://"
IPC_PATH_MAX = 107  # bytes: what a socket's address holds on Linux
FORMS = "ipc:///path or tcp://127.0.0.1:port"
RUNTIME = Path("/run/taxeld")


def fault(endpoint: str, has_keys: bool) -> str | None:
    """Why `endpoint` is refused, with the cure; beyond this machine it takes keys."""
    if endpoint.startswith(IPC):
        path = endpoint.removeprefix(IPC)
        if not path.startswith("/"):
            return f"'{endpoint}' has no absolute path; use {FORMS}"
        if len(os.fsencode(path)) > IPC_PATH_MAX:
            return f"'{endpoint}' is longer than {IPC_PATH_MAX} bytes; use a shorter path"
        return None
    host, _, port = endpoint.removeprefix(TCP).rpartition(":")
    if not endpoint.startswith(TCP) or not host or not _is_port(port):
        return f"'{endpoint}' is no endpoint; use {FORMS}"
    if has_keys or is_local(endpoint):
        return None
    return f"'{endpoint}' is not local; use {FORMS}, or set curve.directory"


def served_fault(endpoint: str, relay_key: str) -> str | None:
    """Why the daemon itself does not serve `endpoint`; `relay_key` is where it may stand."""
    if endpoint.startswith(TCP):
        return (
            f"'{endpoint}' is for the relay: name it in {relay_key} and start "
            "'taxeld relay CONFIG'; the daemon serves ipc:///path alone"
        )
    return fault(endpoint, has_keys=False)


def for_this_user(endpoint: str) -> str:
    """The endpoint, or the user's own in place of one of the service's that is closed to them."""
    path, own = ipc_path(endpoint), own_directory()
    if path is None or path.parent != RUNTIME or own is None or os.access(RUNTIME, os.X_OK):
        return endpoint
    return f"{IPC}{own / path.name}"


def own_directory() -> Path | None:
    """Where a user's own daemon has its sockets, outside the service; made when it is needed."""
    place = os.environ.get("XDG_RUNTIME_DIR")
    return Path(place) / RUNTIME.name if place else None


def is_local(endpoint: str) -> bool:
    """Whether nothing but this machine can reach it."""
    if endpoint.startswith(IPC):
        return True
    host = endpoint.removeprefix(TCP).rpartition(":")[0]
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.removeprefix("[").removesuffix("]")).is_loopback
    except ValueError:
        return False


def ipc_path(endpoint: str) -> Path | None:
    return Path(endpoint.removeprefix(IPC)) if endpoint.startswith(IPC) else None


def no_directory(endpoint: str) -> str | None:
    """The fault of an ipc endpoint whose directory is not there."""
    path = ipc_path(endpoint)
    if path is None or path.parent.is_dir() or path.parent == own_directory():
        return None
    return (
        f"{path.parent} does not exist; the service makes it ('make install'). To try a daemon "
        f"without the service, set XDG_RUNTIME_DIR, or name another endpoint"
    )


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 5 and 0 < int(text) < 65536
