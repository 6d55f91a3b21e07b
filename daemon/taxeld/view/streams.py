"""The streams of a running daemon: a subscriber like any other."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import zmq

from taxeld.errors import SetupError
from taxeld.stream import messages
from taxeld.stream.client import client_socket
from taxeld.stream.sockets import unpack

QUEUE = 1000  # messages kept while the subscriber is busy; it loses later ones
MOST = 500  # messages taken at once
NEEDED = {  # keys that the pictures and the ROS messages read
    messages.ESTIMATE: "t valid why status p radius_m hypotheses contact contacts map mean cov "
    "modes ess particles injected proposal log_evidence age_us overruns lat_us",
    messages.TAXELS: "t z live placed sensor",
    messages.CONTACTS: "t patches",
    messages.PARTICLES: "t xytheta",
    messages.HEALTH: "loop source inputs lat_us dead_taxels",
    messages.INFO: "layout outline object",
}

Message = tuple[bytes, dict[str, Any]]  # a topic, and its map as docs/stream.md has it


class Subscriber:
    """A subscriber to topics of one endpoint; to be closed."""

    def __init__(
        self,
        endpoint: str,
        keys: Path | None = None,
        topics: Sequence[bytes] = messages.TOPICS,
        option: str = "--endpoint",
    ) -> None:
        """`keys`: a directory with server.key and client.key_secret, where the endpoint takes keys.
        `option`: the argument that named the endpoint.

        Raises:
            SetupError: the endpoint is none, or a key cannot be used.
        """
        self._context: zmq.Context[Any] = zmq.Context()
        try:
            self.socket = client_socket(
                self._context, zmq.SUB, endpoint, keys, option, send=len(topics), receive=QUEUE
            )
        except SetupError:
            self._context.term()
            raise
        for topic in topics:
            self.socket.setsockopt(zmq.SUBSCRIBE, topic)

    def close(self) -> None:
        self.socket.close()
        self._context.term()

    def wait(self, for_s: float) -> Iterator[Message]:
        """The messages that have come, `MOST` at most; waits for the first.

        Raises:
            SetupError: a message is of another version, or of another program.
        """
        wait_ms = math.ceil(1e3 * for_s)
        for _ in range(MOST):
            if not self.socket.poll(wait_ms):
                return
            wait_ms = 0
            topic, *rest = self.socket.recv_multipart()
            if topic in NEEDED:
                yield topic, _checked(topic, unpack(rest[0] if rest else b""))


def _checked(topic: bytes, message: dict[str, Any]) -> dict[str, Any]:
    """Raises SetupError where a message is of another version, or has not all that is needed."""
    found = message.get("v")
    if type(found) is not int:
        raise SetupError(
            "what comes is no stream of a taxeld daemon; is the endpoint another program's?"
        )
    if found != messages.VERSION:
        raise SetupError(
            f"the stream is of version {found}, where this taxeld reads {messages.VERSION}; "
            "use the taxeld of the daemon"
        )
    missing = [key for key in NEEDED[topic].split() if key not in message]
    if missing:
        raise SetupError(f"{topic.decode()}: has no '{missing[0]}'; use the taxeld of the daemon")
    return message
