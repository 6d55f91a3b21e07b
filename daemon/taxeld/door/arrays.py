"""Arrays of any skin, by ZeroMQ: each message is checked here (docs/array.md)."""

from collections.abc import Callable
from typing import Any

import zmq

from taxeld.door.heard import REASON_MAX, Heard
from taxeld.stream import pair
from taxeld.stream.sockets import unpack
from taxeld_protocol import array

OnArray = Callable[[array.ArrayFrame], object]


class Published(Heard):
    """Of somebody who publishes: the map is the second frame, or the only one."""

    largest = 262_144
    key = "source.endpoint"

    def __init__(self, context: zmq.Context[Any], endpoint: str, on_array: OnArray) -> None:
        """Raises SetupError where the endpoint is none."""
        super().__init__(context, endpoint)
        self._on_array = on_array

    def _take(self, now_s: float, parts: list[bytes]) -> None:  # noqa: ARG002
        body = parts[len(parts) > 1]
        is_text = body.lstrip()[:1] == b"{"  # msgpack's number 123
        frame = array.parse(array.read_json(body) if is_text else unpack(body))
        if isinstance(frame, str):
            self.line.malformed += 1
            self.line.reason = pair.printable(frame)[:REASON_MAX]
        else:
            self._on_array(frame)
