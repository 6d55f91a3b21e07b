"""The control socket: msgpack {"cmd": …} → {"ok": bool, …}."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgpack
import zmq

from taxeld.curve import Guard
from taxeld.sockets import Inbox, bind, open_socket, unpack

REQUEST_FRAMES = 3  # the client's identity, a delimiter, the body
FRAMES_PER_POLL = 2 * REQUEST_FRAMES
POLL_S = 0.05  # a request costs a sixth of a tick: 40 a second, whoever asks
REQUEST_BYTES = 4096
QUEUED = 16  # requests and answers kept for a client

Handler = Callable[[], dict[str, Any]]


@dataclass(slots=True)
class ControlCounters:
    """Since start."""

    requests: int = 0
    refused: int = 0  # of them: malformed, or of no known command
    failed: int = 0  # of them: the daemon's own fault


class Control:
    """Answers a few requests now and then, so that who asks in a loop costs little."""

    def __init__(
        self, context: zmq.Context[Any], handlers: Mapping[str, Handler], guard: Guard
    ) -> None:
        self.counters = ControlCounters()
        self._next_s = -math.inf
        self._handlers = handlers
        self._guard = guard
        self._pack: Callable[[object], bytes] = msgpack.Packer().pack
        # ROUTER in place of REP: a client that breaks off in mid-request cannot wedge it
        self._socket = open_socket(
            context, zmq.ROUTER, send=QUEUED, receive=QUEUED, largest=REQUEST_BYTES
        )
        self._inbox = Inbox(self._socket, REQUEST_FRAMES)

    def bind(self, endpoint: str) -> None:
        """Raises SetupError where the endpoint cannot be had."""
        if self._guard.takes_keys(endpoint):
            self._guard.serve(self._socket)
        bind(self._socket, endpoint, "control.endpoint")

    def poll(self, now_s: float) -> None:
        """Answer what has been asked; `now_s` is monotonic."""
        if now_s < self._next_s:
            return
        self._next_s = now_s + POLL_S
        for parts in self._inbox.take(FRAMES_PER_POLL):
            *route, body = parts
            self.counters.requests += 1
            answer = self._answer(body if len(parts) <= REQUEST_FRAMES else b"")
            # one that does not fetch its answers loses them
            self._socket.send_multipart([*route[:2], answer], flags=zmq.NOBLOCK)

    def close(self) -> None:
        self._socket.close()

    def _answer(self, body: bytes) -> bytes:
        request = unpack(body)
        command = request.pop("cmd", None)
        handler = self._handlers.get(command) if isinstance(command, str) else None
        if handler is None:
            self.counters.refused += 1
            return self._error(f"unknown cmd {command!r}; known: {', '.join(self._handlers)}")
        if request:
            self.counters.refused += 1
            return self._error(f"unknown key {next(iter(request))!r}; {command} takes none")
        try:
            return self._pack({"ok": True, **handler()})
        except Exception as error:  # a fault in an answer must not end the estimates
            self.counters.failed += 1
            return self._error(f"{command} failed ({error!r})")

    def _error(self, error: str) -> bytes:
        return self._pack({"ok": False, "error": error})
