"""Why no daemon answers at an endpoint: there is none, or this user may not ask it."""

import getpass
import grp
import os
import socket
from pathlib import Path

from taxeld.config import endpoints

PROBE_S = 1.0


def unanswered(endpoint: str) -> str:
    """One line with the cure."""
    path = endpoints.ipc_path(endpoint)
    none = f"no daemon answers at {endpoint}; is 'taxeld run' there?"
    if path is None:
        return none
    if path.parent == endpoints.own_directory() and _is_closed(endpoints.RUNTIME):
        return f"{none} That of the service, in {endpoints.RUNTIME}, {_denied(endpoints.RUNTIME)}"
    if _is_closed(path.parent):
        return f"no permission to ask at {endpoint}: it {_denied(path.parent)}"
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(PROBE_S)
        try:
            probe.connect(str(path))
        except PermissionError:
            return f"no permission to ask at {endpoint}: it {_denied(path)}"
        except OSError:
            return none
    return f"something at {endpoint} takes the question and does not answer; is it a taxeld daemon?"


def _is_closed(directory: Path) -> bool:
    return directory.is_dir() and not os.access(directory, os.X_OK, effective_ids=True)


def _denied(path: Path) -> str:
    """The group of a path, and how this user joins it."""
    try:
        group = grp.getgrgid(path.stat().st_gid).gr_name
        user = getpass.getuser()
    except (OSError, KeyError):
        return "is closed to this user"
    return (
        f"is for members of the group {group}: sudo usermod -aG {group} {user}, then log in again"
    )
