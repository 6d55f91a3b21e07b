"""Control: whatever a client sends, it gets an answer, and the loop gets its tick."""

import contextlib
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.stream import client
from taxeld.stream.control import POLL_S, REQUESTS_AT_ONCE, Control
from taxeld.stream.server import DOOR_S

from .conftest import Sockets
from .crowd import greeted
from .test_curve import free_port


class Desk:
    """A control socket with a command that works and one that does not."""

    def __init__(self, sockets: Sockets, endpoint: str) -> None:
        self.endpoint = endpoint
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
def local(sockets: Sockets, tmp_path: Path) -> Desk:
    return Desk(sockets, f"ipc://{tmp_path}/control")


@pytest.fixture
def remote(sockets: Sockets) -> Desk:
    return Desk(sockets, f"tcp://127.0.0.1:{free_port()}")


@pytest.fixture(params=["local", "remote"])
def desk(request: pytest.FixtureRequest) -> Desk:
    made: Desk = request.getfixturevalue(request.param)
    return made


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
        assert desk.control.counters.requests - before <= REQUESTS_AT_ONCE
    assert desk.done < 200, "the honest one did not wait for the end of the flood"


def test_requests_of_clients_that_have_left_are_not_answered(local: Desk, tmp_path: Path) -> None:
    request = bytes.fromhex("0100000a") + msgpack.packb({"cmd": "work"})
    with greeted(tmp_path / "control", b"REQ", 20, local.poll) as leavers:
        for leaver in leavers:
            with contextlib.suppress(BlockingIOError):
                leaver.sendall(4000 * request)
    assert local.ask(cmd="work") == {"ok": True, "done": 1}
    for _ in range(100):
        local.poll()
    assert local.done == 1


def test_who_sends_a_message_of_very_many_frames_is_hung_up_on_and_nobody_else(
    local: Desk, sockets: Sockets
) -> None:
    honest, flooder = local.client(), local.client(zmq.DEALER)
    lost = sockets.keep(flooder.get_monitor_socket(zmq.EVENT_DISCONNECTED))
    honest.send(msgpack.packb({"cmd": "work"}))
    local.until(honest)
    flooder.send_multipart([b"x"] * 200_000)
    deadline = time.monotonic() + 20.0
    while not local.control.counters.oversized:
        assert time.monotonic() < deadline
        local.poll()
        time.sleep(0.001)
    assert lost.poll(20_000), "who sent it is still connected"
    assert local.control.counters.requests == 1, "of the long one nothing is taken for a request"
    honest.send(msgpack.packb({"cmd": "work"}))
    assert local.until(honest) == {"ok": True, "done": 2}, "over the connection that it had"


def test_over_tcp_a_message_of_very_many_frames_is_not_read_to_its_end(remote: Desk) -> None:
    flooder = remote.client(zmq.DEALER)
    flooder.send_multipart([b"x"] * 200_000)
    deadline = time.monotonic() + 20.0
    while not remote.control.counters.oversized:
        assert time.monotonic() < deadline
        remote.poll()
        time.sleep(0.001)
    assert remote.control.counters.requests == 0, "of the long one nothing is taken for a request"
    assert remote.ask(cmd="work")["ok"]
    assert remote.control.counters.requests == 1


@pytest.mark.parametrize("kind", ["local", "remote"])
def test_who_asks_meanwhile_is_answered(kind: str, request: pytest.FixtureRequest) -> None:
    """`taxeld status` beside a client whose message costs all of a relay's the connection."""
    desk: Desk = request.getfixturevalue(kind)
    flooder = desk.client(zmq.DEALER)
    flooder.send_multipart([b"x"] * 200_000)
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(client.ask, desk.endpoint, "work", timeout_s=20.0)
        while not answer.done():
            desk.poll()
            time.sleep(0.002)
    assert answer.result() == {"ok": True, "done": desk.done}


def test_a_socket_file_that_vanished_is_bound_again(local: Desk, tmp_path: Path) -> None:
    assert local.ask(cmd="work")["ok"]
    (tmp_path / "control").unlink()
    local.now += DOOR_S
    assert local.ask(cmd="work")["ok"]
    assert local.control.counters.bound_again == 1
