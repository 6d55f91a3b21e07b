"""A running daemon: where it is, what it answers and publishes, and why it does neither."""

import getpass
import math
import os
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import zmq

from taxeld.config import endpoints
from taxeld.config.file import load
from taxeld.config.tables import ControlConfig, PublishConfig
from taxeld.errors import SetupError, WorkError
from taxeld.stream import client, messages
from taxeld.stream.sockets import unpack

PUBLISH, CONTROL = "publish.endpoints", "control.endpoint"
PROBE_S = 0.5
QUEUE = 1000  # messages kept while the subscriber is busy; it loses later ones
MOST = 500  # messages taken at once

Message = tuple[bytes, dict[str, Any]]  # a topic, and its map as docs/stream.md has it


def endpoint_of(daemon: str, key: str) -> str:
    """An endpoint of a daemon, which is named by its configuration or by the endpoint itself; where
    nothing is named, of the service, or of this user's own daemon.

    Raises:
        SetupError: the configuration has faults, or the list or endpoint at its `key` is empty.
    """
    if "://" in daemon:
        return daemon
    publish, control = PublishConfig(), ControlConfig()
    if daemon:
        config = load(Path(daemon))
        publish, control = config.publish, config.control
    found = control.endpoint if key == CONTROL else next(iter(publish.endpoints), "")
    if not found:
        raise SetupError(f"{key}: is empty, so this daemon cannot be reached")
    return endpoints.for_this_user(found)


def answer(endpoint: str, command: str, **what: object) -> dict[str, Any]:
    """The answer to a command with the keys `what`.

    Raises:
        SetupError: the endpoint is none, or a key cannot be used.
        WorkError: no daemon answers, or it cannot do what is asked.
    """
    found = client.ask(endpoint, command, None, **what)
    if found is None:
        raise WorkError(unanswered(endpoint))
    if not found.get("ok"):
        raise WorkError(f"{endpoint}: {found.get('error', 'an answer of another kind')}")
    return found


class Subscriber:
    """A subscriber to topics of one endpoint; to be closed."""

    def __init__(self, endpoint: str, topics: Sequence[bytes]) -> None:
        """Raises SetupError: the endpoint is none, or a key cannot be used."""
        context: zmq.Context[Any] = zmq.Context.instance()
        self.socket = client.client_socket(
            context, zmq.SUB, endpoint, send=len(topics), receive=QUEUE
        )
        for topic in topics:
            self.socket.setsockopt(zmq.SUBSCRIBE, topic)

    def close(self) -> None:
        self.socket.close()

    def wait(self, for_s: float) -> Iterator[Message]:
        """The messages that have come, `MOST` at most; waits for the first.

        Raises:
            WorkError: a message is of another version or program.
        """
        wait_ms = math.ceil(1e3 * for_s)
        for _ in range(MOST):
            if not self.socket.poll(wait_ms):
                return
            wait_ms = 0
            topic, *rest = self.socket.recv_multipart()
            message = unpack(rest[0] if rest else b"")
            if message.get("v") != messages.VERSION:
                said = f"is no message of the stream's version {messages.VERSION}, which this"
                name = topic.decode(errors="replace")
                raise WorkError(f"{name}: {said} taxeld reads; use the taxeld of the daemon")
            yield topic, message


def unanswered(endpoint: str) -> str:
    """Why no daemon answers at an endpoint, in one line with the cure."""
    path = endpoints.ipc_path(endpoint)
    none = f"no daemon answers at {endpoint}; is 'taxeld run' there?"
    if path is None:
        return none
    if path.parent == endpoints.own_directory() and _is_closed(endpoints.RUNTIME):
        return f"{none} That of the service, in {endpoints.RUNTIME}, {_denied(endpoints.RUNTIME)}"
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(PROBE_S)
        try:
            probe.connect(str(path))
        except PermissionError:
            closed = path.parent if _is_closed(path.parent) else path
            return f"no permission to ask at {endpoint}: it {_denied(closed)}"
        except OSError:
            return none
    silent = f"something at {endpoint} takes the question and does not answer"
    return f"{silent}; is it a daemon's control endpoint?"


def _is_closed(directory: Path) -> bool:
    return directory.is_dir() and not os.access(directory, os.X_OK, effective_ids=True)


def _denied(path: Path) -> str:
    """Who may open a path: the service's group, which this user may join, or its owner alone."""
    try:
        group, owner = path.group(), path.owner()
    except (OSError, KeyError):
        return "is closed to this user"
    if group == "taxeld":
        join = f"sudo usermod -aG {group} {getpass.getuser()}, then log in again"
        return f"is for members of the group {group}: {join}"
    return (
        f"is open to {owner} alone: ask as {owner}, or run the daemon as the service, which "
        "answers members of the group taxeld"
    )
