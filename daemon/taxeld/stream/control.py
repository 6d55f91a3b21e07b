"""The control socket: it answers a few requests now and then, so that who asks in a loop costs
little."""

import math
from collections.abc import Mapping
from typing import Any

import zmq

from taxeld.config import endpoints
from taxeld.stream import sockets, zmtp
from taxeld.stream.answers import Answers, ControlCounters, Handler
from taxeld.stream.door import Door
from taxeld.stream.guard import Guard
from taxeld.stream.server import Server, Terms
from taxeld.stream.sockets import FRAMES_MAX, open_socket

REQUEST_FRAMES = 2  # a delimiter, the body
REQUESTS_HZ = 80.0  # answered, in the long run
REQUESTS_AT_ONCE = 4
POLL_S = 0.05  # between looks at ZeroMQ's socket
LOOK_S = 0.005  # at least, between looks at ours
REQUEST_BYTES = 4096
QUEUED = 16  # answers kept for a client; and in ZeroMQ requests, too
KINDS = frozenset((b"REQ", b"DEALER", b"ROUTER"))


class Control:
    """Serves one endpoint."""

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
        answers = Answers(handlers, self.counters)
        self._front: _Local | _Network
        if endpoints.ipc_path(endpoint) is not None:
            self._front = _Local(endpoint, key, answers, self.counters)
        else:
            takes_keys = guard is not None and guard.takes_keys(endpoint)
            door = Door(endpoint, key)
            self._front = _Network(
                context, door, answers, self.counters, guard if takes_keys else None
            )

    def fileno(self) -> int:
        """Of a Unix socket's, readable when somebody asks; negative for the relay's."""
        return self._front.fileno()

    def poll(self, now_s: float) -> None:
        """Answer what has been asked; `now_s` is monotonic."""
        self._front.poll(now_s)

    def close(self) -> None:
        self._front.close()


class _Local:
    """Over a Unix socket: by turns of the clients' processes, and never to one that has left."""

    def __init__(
        self, endpoint: str, key: str, answers: Answers, counters: ControlCounters
    ) -> None:
        self._answers = answers
        self._next_s = self._last_s = -math.inf
        self._allowed = 0.0  # requests
        terms = Terms(b"ROUTER", KINDS, REQUEST_BYTES, FRAMES_MAX, QUEUED)
        self._server = Server(endpoint, key, terms, counters)

    def fileno(self) -> int:
        return self._server.fileno()

    def poll(self, now_s: float) -> None:
        if now_s < self._next_s:
            return
        self._next_s = now_s + LOOK_S
        earned = REQUESTS_HZ * (now_s - self._last_s)
        self._allowed = min(self._allowed + earned, REQUESTS_AT_ONCE)
        self._last_s = now_s
        for peer, (*route, body) in self._server.look(now_s, int(self._allowed)):
            self._allowed -= 1.0
            answer = self._answers.to(body if len(route) < REQUEST_FRAMES else b"")
            self._server.send(peer, zmtp.packed([*route[:1], answer]))

    def close(self) -> None:
        self._server.close()


class _Network:
    """Over TCP, the relay's: ZeroMQ's ROUTER; with REP a client that breaks off would wedge it.

    A message of too many frames would hold the others up while it is read; it costs the socket,
    with all that waits in it. Clients are connected to the next one by themselves, and ask again.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        door: Door,
        answers: Answers,
        counters: ControlCounters,
        guard: Guard | None,
    ) -> None:
        self._context, self._door, self._guard = context, door, guard
        self._answers = answers
        self._counters = counters
        self._next_s = -math.inf
        self._socket = self._open()

    @staticmethod
    def fileno() -> int:
        return -1  # its process looks by the clock

    def poll(self, now_s: float) -> None:
        if now_s < self._next_s:
            return
        self._next_s = now_s + POLL_S
        for parts in sockets.messages(self._socket, REQUESTS_AT_ONCE):
            if parts is None:
                self._counters.oversized += 1
                self._socket.close()
                self._socket = self._open()
                return
            client, *route, body = parts
            answer = self._answers.to(body if len(route) < REQUEST_FRAMES else b"")
            # one that does not fetch its answers loses them
            self._socket.send_multipart([client, *route[:1], answer], flags=zmq.NOBLOCK)

    def close(self) -> None:
        self._socket.close()

    def _open(self) -> zmq.Socket[Any]:
        socket = open_socket(
            self._context, zmq.ROUTER, send=QUEUED, receive=QUEUED, largest=REQUEST_BYTES
        )
        if self._guard is not None:
            self._guard.serve(socket)
        self._door.let_in(socket)
        return socket
