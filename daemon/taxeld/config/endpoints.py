"""Endpoints by their text: which may be bound or asked plainly, and which need keys.

Names other than `localhost` are not looked up: their meaning may change after the check.
`/run/taxeld` belongs to the service; a user to whom it is closed gets `$XDG_RUNTIME_DIR/taxeld`
instead.
"""

import ipaddress
import os
from pathlib import Path

IPC = "ipc://"
TCP = "tcp://"
IPC_PATH_MAX = 107  # bytes of a path that fit a socket's address on Linux
FORMS = "ipc:///path or tcp://127.0.0.1:port"
RUNTIME = Path("/run/taxeld")


def fault(endpoint: str, has_keys: bool = False) -> str | None:
    """Why `endpoint` is refused, with the cure; beyond this machine it needs keys."""
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


def for_this_user(endpoint: str) -> str:
    """The endpoint, or the user's own in place of a service endpoint that is closed to them."""
    path, own = ipc_path(endpoint), own_directory()
    if path is None or path.parent != RUNTIME or own is None or os.access(RUNTIME, os.X_OK):
        return endpoint
    return f"{IPC}{own / path.name}"


def own_directory() -> Path | None:
    """The directory of a user's own daemon's sockets, outside the service; made when needed."""
    place = os.environ.get("XDG_RUNTIME_DIR")
    return Path(place) / RUNTIME.name if place else None


def make_directory(endpoint: str) -> None:
    """Make the user's own directory if the endpoint's socket file lies in it."""
    path, own = ipc_path(endpoint), own_directory()
    if path is not None and own is not None and path.parent == own:
        own.mkdir(mode=0o700, exist_ok=True)


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
    """The fault of an ipc endpoint whose directory does not exist."""
    path = ipc_path(endpoint)
    if path is None or path.parent.is_dir() or path.parent == own_directory():
        return None
    return (
        f"{path.parent} does not exist; the service makes it (docs/service.md). To try a daemon "
        f"without the service, set XDG_RUNTIME_DIR, or name another endpoint"
    )


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 5 and 0 < int(text) < 65536
