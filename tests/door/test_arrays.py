"""Arrays through a door of its own: bad ones are counted, and nothing is lost of the others."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld_protocol.array import REST, ArrayFrame

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


def packed(number: int) -> bytes:
    """A message that is numbered by its time."""
    made: bytes = msgpack.packb({"t": float(number), "id": "a", "z": [0.0, 1.0]})
    return made


class Skin:
    """A publisher, and the door that hears it."""

    def __init__(self, place: Path, endpoint: str) -> None:
        self.endpoint, self.came = endpoint, list[ArrayFrame]()
        self.stand = Stand(place, array=endpoint)
        self.stand.link.on_array = self.came.append
        self.publish()

    def publish(self) -> None:
        self.socket = self.stand.socket(zmq.PUB, SNDHWM=0)
        self.stand.until_bound(self.socket, self.endpoint)

    def until_heard(self, number: int, *frames: bytes) -> None:
        """`frames` are sent until they come, by default those of `number` with a topic."""

        def comes() -> bool:
            self.socket.send_multipart(frames or [b"/skin/a", packed(number), b"1.0"])
            return any(frame.t == number for frame in self.came)

        self.stand.until(comes)

    @property
    def line(self) -> Any:
        return self.stand.link.report.array


@pytest.fixture(params=["ipc", "tcp"])
def skin(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Skin]:
    is_ipc = request.param == "ipc"
    made = Skin(tmp_path, f"ipc://{tmp_path}/skin" if is_ipc else f"tcp://127.0.0.1:{free_port()}")
    with made.stand:
        yield made


def test_arrays_come_as_msgpack_and_json_with_a_topic_or_alone(skin: Skin) -> None:
    skin.until_heard(1)
    skin.until_heard(2, packed(2))
    skin.until_heard(3, json.dumps(msgpack.unpackb(packed(3))).encode())
    assert {frame[1:] for frame in skin.came} == {("a", REST, (REST, REST + 20_000))}
    skin.stand.until(lambda: skin.line.connected)
    assert skin.line.malformed == 0


def test_bad_messages_are_counted_with_a_reason_and_cost_no_other(skin: Skin) -> None:
    skin.until_heard(0)
    for number, bomb in enumerate(BOMBS, 1):
        skin.socket.send_multipart([b"/skin", bomb])
        skin.socket.send(packed(number))
    skin.stand.until(lambda: skin.came[-1].t == len(BOMBS))
    assert [f.t for f in skin.came if f.t > 0] == list(range(1, len(BOMBS) + 1))
    skin.stand.until(lambda: skin.line.malformed == len(BOMBS))
    assert skin.line.reason.startswith("z has values that are not from")


@pytest.mark.check
def test_a_message_of_ten_megabytes_costs_the_connection_which_comes_back(skin: Skin) -> None:
    skin.until_heard(1)
    skin.socket.send_multipart([b"/skin", b"x" * 10_000_000])
    skin.until_heard(2)
    skin.socket.send_multipart([b"x"] * 5000)
    skin.until_heard(3)
    assert skin.stand.keeper.starts == 1


def test_a_publisher_that_comes_anew_is_heard_and_by_a_new_door_too(skin: Skin) -> None:
    skin.until_heard(1)
    skin.socket.close()
    skin.publish()
    skin.until_heard(2)
    os.kill(skin.stand.pid, signal.SIGKILL)
    skin.stand.until(lambda: skin.stand.keeper.starts == 2)
    skin.until_heard(3)
