"""Arrays through a door of its own: bad ones are counted, and nothing is lost of the others."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld_protocol.array import REST, ArrayFrame

from ..rig.clocks import until
from ..rig.processes import free_port
from .stand import Stand

BOMBS = [
    b"",
    b"\x00",
    b"[" * 60_000,
    b'{"t":' * 10_000,
    b'{"t":' + b"9" * 60_000 + b"}",
    b"\x91" * 60_000,
    msgpack.packb({"t": 1.0, "id": "a"}),
    msgpack.packb({"t": 1.0, "id": "a", "z": [float("nan")]}),
]


def message(number: int) -> dict[str, Any]:
    """Numbered by its time."""
    return {"t": float(number), "id": "a", "z": [0.0, 1.0]}


class Listener:
    """A door that hears arrays, and what came through it."""

    def __init__(self, place: Path, endpoint: str) -> None:
        self.endpoint, self.came = endpoint, list[ArrayFrame]()
        self.stand = Stand(place, array=endpoint)
        self.stand.link.on_array = self.came.append

    @property
    def line(self) -> Any:
        return self.stand.link.report.array

    def until_heard(self, number: int, send: Any) -> None:
        def comes() -> bool:
            send(message(number))
            return any(frame.t == number for frame in self.came)

        self.stand.until(comes)


@pytest.fixture(params=["ipc", "tcp"])
def listener(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Listener]:
    endpoint = f"ipc://{tmp_path}/skin"
    if request.param == "tcp":
        endpoint = f"tcp://127.0.0.1:{free_port()}"
    made = Listener(tmp_path, endpoint)
    with made.stand:
        yield made


class Publisher:
    """Its messages have a topic, or are the map alone."""

    def __init__(self, listener: Listener) -> None:
        self.socket = listener.stand.socket(zmq.PUB, SNDHWM=0)
        listener.stand.until_bound(self.socket, listener.endpoint)

    def __call__(self, sent: dict[str, Any]) -> None:
        self.socket.send_multipart([b"/skin/a", msgpack.packb(sent), b"1.0"])


def test_arrays_come_as_msgpack_and_json_with_a_topic_or_alone(listener: Listener) -> None:
    send = Publisher(listener)
    listener.until_heard(1, send)
    listener.until_heard(2, lambda sent: send.socket.send(msgpack.packb(sent)))
    listener.until_heard(3, lambda sent: send.socket.send(json.dumps(sent).encode()))
    assert {frame[1:] for frame in listener.came} == {("a", REST, (REST, REST + 20_000))}
    listener.stand.until(lambda: listener.line.connected)
    assert listener.line.malformed == 0


def test_bad_messages_are_counted_with_a_reason_and_cost_no_other(listener: Listener) -> None:
    send = Publisher(listener)
    listener.until_heard(0, send)
    for number, bomb in enumerate(BOMBS, 1):
        send.socket.send_multipart([b"/skin", bomb])
        send(message(number))
    listener.stand.until(lambda: listener.came[-1].t == len(BOMBS))
    assert [f.t for f in listener.came if f.t > 0] == list(range(1, len(BOMBS) + 1))
    listener.stand.until(lambda: listener.line.malformed == len(BOMBS))
    assert listener.line.reason.startswith("z has values that are not from")


@pytest.mark.check
def test_a_message_of_ten_megabytes_costs_the_connection_which_comes_back(
    listener: Listener,
) -> None:
    send = Publisher(listener)
    listener.until_heard(1, send)
    send.socket.send_multipart([b"/skin", b"x" * 10_000_000])
    listener.until_heard(2, send)
    send.socket.send_multipart([b"x"] * 5000)
    listener.until_heard(3, send)
    assert listener.stand.keeper.starts == 1


def test_a_publisher_that_comes_anew_is_heard(listener: Listener) -> None:
    for number in range(3):
        send = Publisher(listener)
        listener.until_heard(number, send)
        send.socket.close()


def test_a_door_that_is_started_again_hears_the_array(listener: Listener) -> None:
    send = Publisher(listener)
    listener.until_heard(1, send)
    before = listener.stand.keeper._process
    assert before is not None
    before.kill()
    until(lambda: listener.stand.keeper.starts == 2)
    listener.until_heard(2, send)
