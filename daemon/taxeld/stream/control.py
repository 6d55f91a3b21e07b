"""The control socket: msgpack {"cmd": …} → {"ok": bool, …}."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgpack
import zmq

from taxeld.stream import sockets
from taxeld.stream.door import Door
from taxeld.stream.guard import Guard
from taxeld.stream.sockets import open_socket, unpack

REQUEST_FRAMES = 3  # the client's identity, a delimiter, the body
REQUESTS_PER_POLL = 4
POLL_S = 0.05
REQUEST_BYTES = 4096
QUEUED = 16  # requests and answers kept for a client
DOOR_S = 1.0  # between looks at the socket file

Handler = Callable[[], dict[str, Any]]


@dataclass(slots=True)
class ControlCounters:
    """Since start."""

    requests: int = 0
    refused: int = 0  # of them: malformed, or of no known command
    failed: int = 0  # of them: the daemon's own fault
    oversized: int = 0  # messages of too many frames, for which all clients are connected anew
    bound_again: int = 0  # times that the socket file had vanished


class Control:
    """Answers a few requests now and then, clients taking turns: who asks in a loop costs little.

    A message of too many frames would hold the others up while it is read; it costs the socket,
    with all that waits in it. Clients are connected to the next one by themselves, and ask again.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        endpoint: str,
        key: str,
        handlers: Mapping[str, Handler],
        guard: Guard | None = None,
    ) -> None:
        """Raises SetupError, in the name of `key`, where the endpoint cannot be had."""
        self.counters = ControlCounters()
        self._context = context
        self._handlers = handlers
        self._guard = guard if guard is not None and guard.takes_keys(endpoint) else None
        self._pack: Callable[[object], bytes] = msgpack.Packer().pack
        self._next_s = self._next_door_s = -math.inf
        self._door = Door(endpoint, key)
        self._socket = self._open()

    def poll(self, now_s: float) -> None:
        """Answer what has been asked; `now_s` is monotonic."""
        if now_s < self._next_s:
            return
        self._next_s = now_s + POLL_S
        for parts in sockets.messages(self._socket, REQUESTS_PER_POLL):
            if parts is None:
                self.counters.oversized += 1
                self._socket.close()
                self._socket = self._open()
                return
            *route, body = parts
            self.counters.requests += 1
            answer = self._answer(body if len(parts) <= REQUEST_FRAMES else b"")
            # one that does not fetch its answers loses them
            self._socket.send_multipart([*route[:2], answer], flags=zmq.NOBLOCK)
        if now_s >= self._next_door_s:
            self._next_door_s = now_s + DOOR_S
            self.counters.bound_again += self._door.restore(self._socket)

    def close(self) -> None:
        self._socket.close()
        self._door.close()

    def _open(self) -> zmq.Socket[Any]:
        # ROUTER in place of REP: a client that breaks off in mid-request cannot wedge it
        socket = open_socket(
            self._context, zmq.ROUTER, send=QUEUED, receive=QUEUED, largest=REQUEST_BYTES
        )
        if self._guard is not None:
            self._guard.serve(socket)
        self._door.let_in(socket)
        return socket

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
