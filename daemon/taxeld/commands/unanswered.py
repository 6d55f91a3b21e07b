"""Why no daemon answers at an endpoint: there is none, or this user may not ask it."""

import getpass
import grp
import os
import pwd
import socket
from pathlib import Path

from taxeld.config import endpoints
from taxeld.stream import client, messages

PROBE_S = 0.5
FIRST_PERSON = 1000  # smaller user numbers are of services (UID_MIN of login.defs)


def unanswered(endpoint: str) -> str:
    """One line with the cure."""
    if client.hears(endpoint, messages.ESTIMATE, PROBE_S):
        return (
            f"{endpoint} is where a daemon publishes; name its control endpoint, control.endpoint "
            "or relay.control of its configuration"
        )
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
    """The group of a path, and how this user joins it, unless it is root's or a person's own."""
    try:
        number = path.stat().st_gid
        group, user = grp.getgrgid(number).gr_name, getpass.getuser()
    except (OSError, KeyError):
        return "is closed to this user"
    if number == 0 or _is_of_a_person(group, number):
        owner = group if number else "root"
        return (
            f"is open to {owner} and its group alone: ask as {owner}, or run the daemon as the "
            "service, which answers members of the group taxeld"
        )
    return (
        f"is for members of the group {group}: sudo usermod -aG {group} {user}, then log in again"
    )


def _is_of_a_person(group: str, number: int) -> bool:
    """Whether a group is the one that a user of the same name has alone."""
    try:
        own = pwd.getpwnam(group)
    except KeyError:
        return False
    return own.pw_gid == number and own.pw_uid >= FIRST_PERSON
