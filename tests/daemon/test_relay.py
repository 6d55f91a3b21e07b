"""The relay: what a peer does to it the daemon does not feel."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.cli import main
from taxeld.commands.relay import Relay
from taxeld.config.file import load
from taxeld.errors import SetupError
from taxeld.stream import client, messages

from .conftest import Sockets
from .recorded import configuration, write_session
from .test_curve import free_port

ATTACK = """
import sys, zmq
for _ in range(40):
    with zmq.Context() as context:
        socket = context.socket(zmq.XSUB)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDHWM, 0)
        socket.connect(sys.argv[1])
        for n in range(5000):
            socket.send(b"\\x01%d" % n)
        socket.poll(20)
        socket.close()
"""
PATIENCE_S = 60.0


class Running:
    """A daemon that replays a long session, and its relay; processes of their own."""

    def __init__(self, place: Path, more: str = "") -> None:
        self.stream = f"tcp://127.0.0.1:{free_port()}"
        self.control = f"tcp://127.0.0.1:{free_port()}"
        self.place = place
        write_session(place, touches=60)
        relay = f'[relay]\npublish = ["{self.stream}"]\ncontrol = "{self.control}"\n{more}'
        self.config = configuration(place, relay)
        self.daemon = self._start("run")
        self.relay = self._start("relay")

    def _start(self, command: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-m", "taxeld.cli", command, str(self.config)])

    def ask(self, command: str) -> dict[str, Any]:
        """Of the relay; once the daemon has been heard."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            answer = client.ask(self.control, command, timeout_s=1.0)
            if answer is not None and "is 'taxeld run' there" not in answer.get("error", ""):
                return answer
            assert time.monotonic() < deadline, answer
            time.sleep(0.1)

    def stop(self) -> None:
        for process in (self.relay, self.daemon):
            process.terminate()
            process.wait(PATIENCE_S)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    made = Running(tmp_path)
    yield made
    made.stop()


def subscribe(sockets: Sockets, endpoint: str, topic: bytes = b"") -> zmq.Socket[Any]:
    socket = sockets.open(zmq.SUB)
    socket.setsockopt(zmq.RCVHWM, 0)
    socket.setsockopt(zmq.SUBSCRIBE, topic)
    socket.connect(endpoint)
    return socket


def first(socket: zmq.Socket[Any]) -> dict[str, Any]:
    assert socket.poll(1000 * PATIENCE_S), "nothing was relayed"
    message: dict[str, Any] = msgpack.unpackb(socket.recv_multipart()[1])
    return message


def test_peers_that_flood_and_leave_cost_the_daemons_subscribers_nothing(
    running: Running, sockets: Sockets
) -> None:
    """What ended a daemon that listened on TCP itself, where ZeroMQ sends heartbeats."""
    running.ask("info")
    honest = subscribe(sockets, f"ipc://{running.place}/stream", messages.ESTIMATE)
    first(honest)
    subprocess.run([sys.executable, "-c", ATTACK, running.stream], check=True, timeout=PATIENCE_S)
    assert running.daemon.poll() is None, "the daemon has ended"
    ticks = []
    while honest.poll(0):
        ticks.append(msgpack.unpackb(honest.recv_multipart()[1]))
    missed = ticks[-1]["overruns"] - ticks[0]["overruns"]
    assert len(ticks) > 10
    assert [e["seq"] for e in ticks] == list(range(ticks[0]["seq"], ticks[0]["seq"] + len(ticks)))
    assert missed < ticks[-1]["seq"], "the loop went on"
    assert running.ask("status")["ok"], "and so did the relay"


def test_every_topic_is_relayed_as_it_came_and_late_joiners_are_told_who_speaks(
    running: Running, sockets: Sockets
) -> None:
    here = subscribe(sockets, f"ipc://{running.place}/stream", messages.INFO)
    info = first(here)
    everything = subscribe(sockets, running.stream)
    heard = set()
    while heard != set(messages.TOPICS):
        assert everything.poll(1000 * PATIENCE_S), heard
        topic, _, stamp = everything.recv_multipart()
        heard.add(topic)
        float(stamp)
    for _ in range(2):
        assert first(subscribe(sockets, running.stream, messages.INFO)) == info


def test_a_relay_leaves_out_the_time_where_it_is_configured_so(
    sockets: Sockets, tmp_path: Path
) -> None:
    """For a PlotJuggler that spoils the map when a third frame follows it."""
    running = Running(tmp_path, "frames = 2\n")
    try:
        running.ask("info")
        everything = subscribe(sockets, running.stream)
        heard: dict[bytes, list[bytes]] = {}
        while heard.keys() < set(messages.TOPICS):
            assert everything.poll(1000 * PATIENCE_S), heard.keys()
            topic, *rest = everything.recv_multipart()
            heard[topic] = rest
    finally:
        running.stop()
    for body, *more in heard.values():
        assert msgpack.unpackb(body)["v"] == messages.VERSION
        assert more == []


def test_who_reaches_the_relay_may_read_and_change_nothing(
    running: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    status = running.ask("status")
    assert set(status) == {"ok", "estimate", "health"}
    assert running.ask("info")["info"]["layout"]["taxels"] == 80
    for command in ("tare", "reset"):
        answer = running.ask(command)
        assert answer == {"ok": False, "error": f"unknown cmd '{command}'; known: status, info"}
    assert main(["status", "--endpoint", running.control]) == 0
    assert capsys.readouterr().out.startswith("Status")


def test_where_it_is_said_so_the_relay_passes_changes_on(tmp_path: Path) -> None:
    running = Running(tmp_path, "change = true\n")
    try:
        running.ask("info")
        assert running.ask("reset") == {"ok": True}
        health = client.ask(f"ipc://{tmp_path}/control", "status", timeout_s=PATIENCE_S)
        assert health is not None
        running.daemon.terminate()
        running.daemon.wait(PATIENCE_S)
        answer = client.ask(running.control, "reset", timeout_s=PATIENCE_S)
        assert answer is not None
        assert answer["error"].startswith("the daemon does not answer")
    finally:
        running.stop()


def test_a_relay_outlives_its_daemon_and_says_that_it_is_silent(running: Running) -> None:
    assert running.ask("status")["ok"]
    running.daemon.kill()
    running.daemon.wait(PATIENCE_S)
    deadline = time.monotonic() + PATIENCE_S
    while (answer := client.ask(running.control, "status") or {"ok": True})["ok"]:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert answer["error"].startswith("the daemon is silent")
    running.daemon = running._start("run")
    assert running.ask("status")["ok"]
    running.relay.send_signal(signal.SIGTERM)
    assert running.relay.wait(PATIENCE_S) == 0


def test_no_signal_but_to_stop_ends_a_relay(running: Running) -> None:
    assert running.ask("status")["ok"]
    for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM):
        running.relay.send_signal(number)
    assert running.ask("info")["ok"]
    assert running.relay.poll() is None
    running.relay.send_signal(signal.SIGTERM)
    assert running.relay.wait(PATIENCE_S) == 0


@pytest.mark.parametrize(
    ("more", "fault"),
    [
        ("[relay]\npublish = []\n", "relay.publish: is empty"),
        ("[relay]\npublish = ['tcp://127.0.0.1:{port}']\n", "relay.publish: cannot bind tcp://127"),
    ],
)
def test_a_relay_that_cannot_be_is_one_line_and_status_2(
    tmp_path: Path, sockets: Sockets, capsys: pytest.CaptureFixture[str], more: str, fault: str
) -> None:
    taken = sockets.open(zmq.XPUB)
    port = taken.bind_to_random_port("tcp://127.0.0.1")
    config = configuration(tmp_path, more.format(port=port))
    assert main(["relay", str(config)]) == 2
    line = capsys.readouterr().err
    assert line.startswith(fault)
    assert line.count("\n") == 1
    with pytest.raises(SetupError):
        Relay(load(config))
