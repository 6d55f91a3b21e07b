"""The streams of a running daemon, or of its relay: a subscriber like any other."""

import math
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zmq

from taxeld.config import endpoints
from taxeld.errors import SetupError
from taxeld.stream import curve, messages
from taxeld.stream.client import ANSWER_BYTES, OWN, SERVER
from taxeld.stream.sockets import connect, open_socket, unpack
from taxeld.view.stage import Message, check_version

QUEUE = (
    1000  # messages that wait for a viewer that is busy; what comes beyond is dropped, by its end
)
MOST = 500  # of one look
NEEDED = {  # keys of each topic that are looked at
    messages.ESTIMATE: ("t", "seq", "valid", "status", "contact", "map", "mean", "cov", "modes",
                        "ess", "age_us", "lat_us"),
    messages.TAXELS: ("t", "z", "live"),
    messages.PARTICLES: ("t", "xytheta", "weight"),
    messages.HEALTH: ("t", "loop", "source", "inputs", "lat_us", "dead_taxels"),
    messages.INFO: (),
}  # fmt: skip


class Streams:
    """All topics of one endpoint."""

    def __init__(self, endpoint: str, keys: Path | None = None) -> None:
        """`keys`: a directory with server.key and client.key_secret, for a relay that takes keys.

        Raises:
            SetupError: the endpoint is none, or a key cannot be used.
        """
        fault = endpoints.fault(endpoint, keys is not None)
        if fault:
            raise SetupError(f"--endpoint: {fault.replace('set curve.directory', 'name --keys')}")
        self.endpoint = endpoint
        self._context = zmq.Context()
        self._socket = open_socket(
            self._context, zmq.SUB, send=1, receive=QUEUE, largest=ANSWER_BYTES
        )
        try:
            if keys is not None and endpoint.startswith(endpoints.TCP):
                own = curve.secret_key(keys / OWN, "--keys")
                curve.as_client(self._socket, curve.public_key(keys / SERVER, "--keys"), *own)
            self._socket.setsockopt(zmq.SUBSCRIBE, b"/taxeld/")
            connect(self._socket, endpoint, "--endpoint")
        except SetupError:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()
        self._context.term()

    def wait(self, for_s: float) -> Iterator[Message]:
        """What has come, `MOST` at most; waits for the first.

        Raises:
            SetupError: a message is of another version, or of another program.
        """
        wait_ms = math.ceil(1e3 * for_s)
        for _ in range(MOST):
            if not self._socket.poll(wait_ms):
                return
            wait_ms = 0
            topic, *rest = self._socket.recv_multipart()
            if topic in NEEDED:
                yield topic, _checked(topic, unpack(rest[0] if rest else b""))


def _checked(topic: bytes, message: dict[str, Any]) -> dict[str, Any]:
    """The map, with what an older daemon of the same version of the stream does not send."""
    check_version(message)
    missing = [key for key in NEEDED[topic] if key not in message]
    if missing:
        raise SetupError(
            f"{topic.decode()}: has no '{missing[0]}'; is the endpoint another program's?"
        )
    if topic == messages.TAXELS and "placed" not in message:
        message |= {"placed": False, "sensor": {"x": 0.0, "y": 0.0, "theta": 0.0}}
    return message
