"""A context of ZeroMQ and its sockets, which are closed at a test's end."""

import contextlib
from typing import Any

import zmq


class Sockets(contextlib.ExitStack):
    """A context, and the sockets of a test, which are closed at its end."""

    def __init__(self) -> None:
        super().__init__()
        self.context: zmq.Context[Any] = self.enter_context(zmq.Context())

    def open(self, kind: int) -> zmq.Socket[Any]:
        return self.keep(self.context.socket(kind))

    def subscriber(self, endpoint: str, *topics: bytes) -> zmq.Socket[Any]:
        """It hears from then on; without topics, everything."""
        made = self.open(zmq.SUB)
        for topic in topics or (b"",):
            made.setsockopt(zmq.SUBSCRIBE, topic)
        made.connect(endpoint)
        return made

    def keep(self, socket: zmq.Socket[Any]) -> zmq.Socket[Any]:
        socket.setsockopt(zmq.LINGER, 0)
        return self.enter_context(socket)
