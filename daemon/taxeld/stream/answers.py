"""Requests and their answers: msgpack {"cmd": …} → {"ok": bool, …}."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgpack

from taxeld.stream.server import PeerCounters
from taxeld.stream.sockets import unpack

Handler = Callable[[], dict[str, Any]]


@dataclass(slots=True)
class ControlCounters(PeerCounters):
    """Since start."""

    requests: int = 0
    refused: int = 0  # of them: malformed, or of no known command
    failed: int = 0  # of them: the daemon's own fault


class Answers:
    """The commands, by name."""

    def __init__(self, handlers: Mapping[str, Handler], counters: ControlCounters) -> None:
        self._handlers = handlers
        self._counters = counters
        self._pack: Callable[[object], bytes] = msgpack.Packer().pack

    def to(self, body: bytes) -> bytes:
        """The answer to a request; whatever that holds, there is one."""
        self._counters.requests += 1
        request = unpack(body)
        command = request.pop("cmd", None)
        handler = self._handlers.get(command) if isinstance(command, str) else None
        if handler is None:
            self._counters.refused += 1
            return self._error(f"unknown cmd {command!r}; known: {', '.join(self._handlers)}")
        if request:
            self._counters.refused += 1
            return self._error(f"unknown key {next(iter(request))!r}; {command} takes none")
        try:
            return self._pack({"ok": True, **handler()})
        except Exception as error:  # a fault in an answer must not end the estimates
            self._counters.failed += 1
            return self._error(f"{command} failed ({error!r})")

    def _error(self, error: str) -> bytes:
        return self._pack({"ok": False, "error": error})
