"""Control: whatever a client sends, it gets an answer, and the loop gets its tick."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.stream import client
from taxeld.stream.control import DOOR_S, POLL_S, REQUESTS_PER_POLL, Control

from .conftest import Sockets


class Desk:
    """A control socket with a command that works and one that does not."""

    def __init__(self, sockets: Sockets, place: Path) -> None:
        self.endpoint = f"ipc://{place}/control"
        self.done, self.now = 0, 0.0
        self._sockets = sockets
        handlers = {"work": self._work, "break": self._break, "mangle": lambda: {"x": object()}}
        self.control = Control(sockets.context, self.endpoint, "control.endpoint", handlers)
        sockets.callback(self.control.close)

    def client(self, kind: int = zmq.REQ) -> zmq.Socket[Any]:
        socket = self._sockets.open(kind)
        socket.connect(self.endpoint)
        return socket

    def until(self, socket: zmq.Socket[Any]) -> dict[str, Any]:
        deadline = time.monotonic() + 10.0
        while not socket.poll(2):
            assert time.monotonic() < deadline, "no answer"
            self.poll()
        answer: dict[str, Any] = msgpack.unpackb(socket.recv_multipart()[-1])
        return answer

    def poll(self) -> None:
        self.now += POLL_S
        self.control.poll(self.now)

    def ask(self, **request: object) -> dict[str, Any]:
        with self.client() as socket:
            socket.send(msgpack.packb(request))
            return self.until(socket)

    def _work(self) -> dict[str, Any]:
        self.done += 1
        return {"done": self.done}

    def _break(self) -> dict[str, Any]:
        raise RuntimeError("no luck")


@pytest.fixture
def desk(sockets: Sockets, tmp_path: Path) -> Desk:
    return Desk(sockets, tmp_path)


def test_what_is_unknown_is_named_and_counted(desk: Desk) -> None:
    assert desk.ask(cmd="work") == {"ok": True, "done": 1}
    assert desk.ask(cmd="play")["error"] == "unknown cmd 'play'; known: work, break, mangle"
    assert desk.ask(cmd="work", hard=1)["error"] == "unknown key 'hard'; work takes none"
    assert desk.ask()["error"].startswith("unknown cmd None")
    assert desk.done == 1
    assert desk.control.counters.requests == 4
    assert desk.control.counters.refused == 3


@pytest.mark.parametrize("command", ["break", "mangle"])
def test_a_command_that_fails_is_an_answer(desk: Desk, command: str) -> None:
    answer = desk.ask(cmd=command)
    assert not answer["ok"]
    assert answer["error"].startswith(f"{command} failed (")
    assert desk.control.counters.failed == 1
    assert desk.ask(cmd="work")["ok"]


@pytest.mark.parametrize("parts", [[b""], [b"", b""], [b"x"] * 2, [b"x"] * 3, [b"x"] * 7])
def test_messages_of_any_shape_do_no_harm(desk: Desk, parts: list[bytes]) -> None:
    odd = desk.client(zmq.DEALER)
    odd.send_multipart(parts)
    assert not desk.until(odd)["ok"]
    assert desk.ask(cmd="work")["ok"]


def test_a_flood_waits_and_others_take_turns_with_it(desk: Desk) -> None:
    flooder, honest = desk.client(zmq.DEALER), desk.client()
    request = msgpack.packb({"cmd": "work"})
    for _ in range(200):
        flooder.send_multipart([b"", request])
    while desk.done == 0:
        desk.poll()
    honest.send(request)
    deadline = time.monotonic() + 10.0
    while not honest.poll(2):
        assert time.monotonic() < deadline
        before = desk.control.counters.requests
        desk.poll()
        assert desk.control.counters.requests - before <= REQUESTS_PER_POLL
    assert desk.done < 200, "the honest one did not wait for the end of the flood"


def test_a_message_of_very_many_frames_is_not_read_to_its_end(desk: Desk) -> None:
    flooder = desk.client(zmq.DEALER)
    flooder.send_multipart([b"x"] * 200_000)
    deadline = time.monotonic() + 20.0
    while not desk.control.counters.oversized:
        assert time.monotonic() < deadline
        desk.poll()
        time.sleep(0.001)
    assert desk.control.counters.requests == 0, "of the long one nothing is taken for a request"
    assert desk.ask(cmd="work")["ok"]
    assert desk.control.counters.requests == 1


def test_who_asks_meanwhile_asks_again_by_itself(desk: Desk) -> None:
    """`taxeld status` beside a client whose message costs everybody the connection."""
    flooder = desk.client(zmq.DEALER)
    flooder.send_multipart([b"x"] * 200_000)
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(client.ask, desk.endpoint, "work", timeout_s=20.0)
        while not answer.done():
            desk.poll()
            time.sleep(0.002)
    assert answer.result() == {"ok": True, "done": desk.done}


def test_a_socket_file_that_vanished_is_bound_again(desk: Desk, tmp_path: Path) -> None:
    assert desk.ask(cmd="work")["ok"]
    (tmp_path / "control").unlink()
    desk.now += DOOR_S
    assert desk.ask(cmd="work")["ok"]
    assert desk.control.counters.bound_again == 1
