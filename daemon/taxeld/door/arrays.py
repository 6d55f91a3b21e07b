"""Arrays of any skin, by ZeroMQ or as datagrams: each message is checked here, and passed on packed
(docs/array.md)."""

import socket
from collections.abc import Callable
from typing import Any

import zmq

from taxeld.config.endpoints import UDP
from taxeld.door.heard import Heard
from taxeld.errors import SetupError
from taxeld.stream import pair
from taxeld.stream.link import REASON_MAX, PeerLine
from taxeld.stream.sockets import unpack
from taxeld_protocol import array

KEY = "source.endpoint"
MESSAGE_BYTES = 262_144
DATAGRAM_BYTES = 65_536
DATAGRAMS_PER_LOOK = 200
OWNED_S = 1.0  # a sender that is silent for so long may be followed by another

OnArray = Callable[[bytes], object]


def take(line: PeerLine, body: bytes, on_array: OnArray) -> None:
    """Pass on the array in a message, or count that it is none."""
    is_text = body.lstrip()[:1] == b"{"  # msgpack's number 123
    frame = array.parse(array.read_json(body) if is_text else unpack(body))
    if isinstance(frame, str):
        line.malformed += 1
        line.reason = frame[:REASON_MAX]
    else:
        on_array(pair.pack_array(frame))


class Published(Heard):
    """Of somebody who publishes: the map is the second frame, or the only one."""

    largest = MESSAGE_BYTES
    key = KEY

    def __init__(self, context: zmq.Context[Any], endpoint: str, on_array: OnArray) -> None:
        """Raises SetupError where the endpoint is none."""
        super().__init__(context, endpoint)
        self._on_array = on_array

    @property
    def waits_on(self) -> Any:
        return self.socket

    def _take(self, now_s: float, parts: list[bytes]) -> None:  # noqa: ARG002
        take(self.line, parts[len(parts) > 1], self._on_array)


class Datagrams:
    """Sent to a port of this machine, by one sender at a time."""

    def __init__(self, endpoint: str, on_array: OnArray) -> None:
        """Raises SetupError where the port cannot be had."""
        self.line = PeerLine()
        self._on_array = on_array
        self._owner: object = None  # address of the sender that is heard
        self._heard_s = 0.0
        host, _, port = endpoint.removeprefix(UDP).rpartition(":")
        family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host.strip("[]"), int(port)))
        except OSError as error:
            self._socket.close()
            raise SetupError(f"{KEY}: cannot listen at {endpoint} ({error.strerror})") from None

    @property
    def waits_on(self) -> Any:
        return self._socket.fileno()

    def poll(self, now_s: float) -> None:
        """Take the datagrams that have arrived."""
        for _ in range(DATAGRAMS_PER_LOOK):
            try:
                body, sender = self._socket.recvfrom(DATAGRAM_BYTES)
            except OSError:
                break
            if now_s > self._heard_s + OWNED_S:
                self._owner = sender
            if sender != self._owner:
                self.line.malformed += 1
                self.line.reason = "datagrams come from two senders; stop one of them"
                continue
            self._heard_s, self.line.connected = now_s, True
            take(self.line, body, self._on_array)

    def look(self, now_s: float) -> bool:
        """Whether somebody sends; the socket is always the same."""
        self.line.connected = now_s <= self._heard_s + OWNED_S
        return False

    def close(self) -> None:
        self._socket.close()


def open_arrays(
    context: zmq.Context[Any], endpoint: str, on_array: OnArray
) -> Published | Datagrams:
    """Raises SetupError where the endpoint cannot be used."""
    if endpoint.startswith(UDP):
        return Datagrams(endpoint, on_array)
    return Published(context, endpoint, on_array)
