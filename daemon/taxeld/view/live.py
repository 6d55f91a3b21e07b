"""The streams of a running daemon: a subscriber like any other."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import zmq

from taxeld.config import endpoints
from taxeld.errors import SetupError
from taxeld.stream import curve, messages
from taxeld.stream.client import ANSWER_BYTES, OWN, SERVER
from taxeld.stream.sockets import connect, open_socket, unpack
from taxeld.view.stage import Message

QUEUE = 1000  # messages that wait while the subscriber is busy; more are dropped, on its own side
MOST = 500  # messages of one look
NEEDED = {  # keys that the pictures and the ROS messages take
    messages.ESTIMATE: "t valid status contact contacts map mean cov modes ess particles injected "
    "proposal log_evidence age_us overruns lat_us",
    messages.TAXELS: "t z live placed sensor",
    messages.PARTICLES: "t xytheta",
    messages.HEALTH: "loop source inputs lat_us dead_taxels",
    messages.INFO: "layout outline object",
}


class Streams:
    """All topics of one endpoint, or some; to be closed."""

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
        fault = endpoints.fault(endpoint, keys is not None)
        if fault:
            raise SetupError(f"{option}: {fault.replace('set curve.directory', 'name --keys')}")
        self._context = zmq.Context()
        self.socket = open_socket(
            self._context, zmq.SUB, send=len(topics), receive=QUEUE, largest=ANSWER_BYTES
        )
        try:
            if keys is not None and endpoint.startswith(endpoints.TCP):
                own = curve.secret_key(keys / OWN, "--keys")
                curve.as_client(self.socket, curve.public_key(keys / SERVER, "--keys"), *own)
            for topic in topics:
                self.socket.setsockopt(zmq.SUBSCRIBE, topic)
            connect(self.socket, endpoint, option)
        except SetupError:
            self.close()
            raise

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
