"""Descriptors: as many as are allowed, and no start where they are too few to work with."""

import contextlib
import resource

from taxeld.errors import SetupError

OWN = 64  # devices, sockets, files and libraries, and some to spare
CLIENTS = 64  # each connection takes one
NEEDED = OWN + CLIENTS
MOST = 65_536  # where there is no limit: tables are made for so many


def ensure() -> None:
    """Raise the limit as far as it goes.

    Raises:
        SetupError: it is too low.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST if hard == resource.RLIM_INFINITY else min(hard, MOST)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            soft = wanted
    if soft != resource.RLIM_INFINITY and soft < NEEDED:
        raise SetupError(
            f"{soft} open files are allowed, and the daemon needs {NEEDED}: raise the limit "
            "(LimitNOFILE= of the unit, or ulimit -n)"
        )
