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
NEEDED = {  # topic → keys that the view and the bridge read
    messages.ESTIMATE: "t valid why status p radius_m hypotheses contact contacts object map mean "
    "cov modes ess particles injected proposal age_us",
    messages.TAXELS: "t z live placed sensor",
    messages.PARTICLES: "t xytheta",
    messages.HEALTH: "loop lat_us dead_taxels",
    messages.INFO: "layout objects",
}

Message = tuple[bytes, dict[str, Any]]  # a topic, and its map as docs/stream.md has it


class Subscriber:
    """A subscriber to topics of one endpoint, each of `NEEDED`; to be closed."""

    def __init__(
        self, endpoint: str, keys: Path | None, topics: Sequence[bytes], option: str = "--endpoint"
    ) -> None:
        """`option`: the argument that named the endpoint.

        Raises:
            SetupError: the endpoint is none, or a key cannot be used.
        """
        context: zmq.Context[Any] = zmq.Context.instance()
        kept = {"send": len(topics), "receive": QUEUE}
        self.socket = client_socket(context, zmq.SUB, endpoint, keys, option, **kept)
        for topic in topics:
            self.socket.setsockopt(zmq.SUBSCRIBE, topic)

    def close(self) -> None:
        self.socket.close()

    def wait(self, for_s: float) -> Iterator[Message]:
        """The messages that have come, `MOST` at most; waits for the first.

        Raises:
            SetupError: a message is of another version or program.
        """
        wait_ms = math.ceil(1e3 * for_s)
        for _ in range(MOST):
            if not self.socket.poll(wait_ms):
                return
            wait_ms = 0
            topic, *rest = self.socket.recv_multipart()
            message = unpack(rest[0] if rest else b"")
            needed = NEEDED.get(topic, "?").split()
            if message.get("v") != messages.VERSION or not message.keys() >= set(needed):
                said = f"is no message of the stream's version {messages.VERSION}, which this"
                name = topic.decode(errors="replace")
                raise SetupError(f"{name}: {said} taxeld reads; use the taxeld of the daemon")
            yield topic, message
