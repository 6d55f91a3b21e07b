"""The loop's own Unix sockets: whoever comes costs a bounded part of a look, and nobody else."""

import os
import socket as kernel
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from taxeld.stream import server, zmtp
from taxeld.stream.server import (
    ACCEPTS_PER_LOOK,
    DOOR_S,
    HANDSHAKE_S,
    READ_BYTES,
    SPARE,
    WRITES_PER_LOOK,
    Peer,
    PeerCounters,
    Server,
    Terms,
)

from .crowd import PIPES, crowd

TERMS = Terms(b"ROUTER", frozenset([b"DEALER"]), largest=1000, frames=2, queue=5)
HELLO = zmtp.hello(b"DEALER")
LIMITED = """
import os, resource, select, sys, time
from taxeld.stream.server import SPARE, PeerCounters, Server, Terms
resource.setrlimit(resource.RLIMIT_NOFILE, (100, 100))
server = Server(f"ipc://{sys.argv[1]}", "x", Terms(b"XPUB", frozenset(), 9, 1, 1), PeerCounters())
print("there", flush=True)
while not select.select([sys.stdin], [], [], 0.01)[0]:
    list(server.look(time.monotonic(), 9))
opened = [os.open(os.devnull, os.O_RDONLY) for _ in range(SPARE)]
print(len(server._peers), server._counters.crowded_out, len(opened))
"""


class Hall:
    """A server, and a clock of its own."""

    def __init__(self, place: Path) -> None:
        self.path = place / "hall"
        self.counters = PeerCounters()
        self.gone: list[Peer] = []
        self.now = 0.0
        self.server = Server(f"ipc://{self.path}", "hall", TERMS, self.counters, self.gone.append)
        self._callers: list[kernel.socket] = []

    def caller(self, said: bytes = HELLO) -> kernel.socket:
        """Somebody who has connected."""
        made = kernel.socket(kernel.AF_UNIX)
        self._callers.append(made)
        made.settimeout(10.0)
        made.connect(str(self.path))
        made.sendall(said)
        return made

    def look(self, most: int = 100) -> list[list[bytes]]:
        self.now += 0.01
        return [message for _, message in self.server.look(self.now, most)]

    def until_ready(self, count: int) -> None:
        """All that have called have said who they are."""
        for _ in range(100):
            self.look()
            peers = self.server._peers.values()
            if len(peers) == count and all(peer.conversation.is_ready for peer in peers):
                return
        raise AssertionError

    def close(self) -> None:
        self.server.close()
        for caller in self._callers:
            caller.close()


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    made = Hall(tmp_path)
    yield made
    made.close()


def message(n: int) -> bytes:
    return zmtp.packed([b"%d" % n])


def is_hung_up(caller: kernel.socket) -> bool:
    """Whether the server has closed its end, after whatever it had sent."""
    try:
        while caller.recv(65536):
            pass
    except ConnectionResetError:  # with something unread
        return True
    except TimeoutError:
        return False
    return True


def test_connections_take_turns_however_much_one_sends(hall: Hall) -> None:
    loud, honest = hall.caller(), hall.caller()
    hall.until_ready(2)
    loud.sendall(b"".join(map(message, range(100))))
    honest.sendall(message(1000))
    heard = [int(body) for _ in range(4) for (body,) in hall.look(most=2)]
    assert heard.index(1000) <= 2
    assert heard[-1] < 8, "and no more is taken than was asked for"


def test_processes_take_turns_however_many_connections_one_has(hall: Hall) -> None:
    with crowd(hall.path, 15, HELLO + message(7) * 50):
        for _ in range(20):
            hall.look(most=1)
        hall.caller(HELLO + message(1000))
        heard = [int(body) for _ in range(8) for (body,) in hall.look(most=1)]
        assert heard.count(7) >= 4
        assert 1000 in heard


def test_who_has_left_is_answered_no_more(hall: Hall) -> None:
    leaver = hall.caller()
    hall.until_ready(1)
    leaver.sendall(message(1) * 50)
    assert hall.look(most=1) == [[b"1"]]
    leaver.close()
    assert hall.look() == []
    assert len(hall.gone) == 1


def test_a_look_reads_a_little_of_each_peer(hall: Hall) -> None:
    hall.caller(HELLO + zmtp.packed([b"x" * 900]) * 100)
    heard = [len(hall.look()) for _ in range(10)]
    assert max(heard) <= READ_BYTES // 900 + 1
    assert sum(heard) > 20


def test_a_look_lets_in_a_few(hall: Hall) -> None:
    for _ in range(3 * ACCEPTS_PER_LOOK):
        hall.caller()
    for looks in range(1, 4):
        hall.look()
        assert len(hall.server._peers) == looks * ACCEPTS_PER_LOOK


@pytest.mark.parametrize(
    ("said", "counter"),
    [
        (b"GET / HTTP/1.1\r\n", "strangers"),
        (HELLO + b"\x02\xff\xff\xff\xff\xff\xff\xff\xff", "oversized"),
        (HELLO + b"\x01\x00" * 3, "oversized"),
    ],
)
def test_who_speaks_otherwise_or_without_end_is_hung_up_on_and_nobody_else(
    hall: Hall, said: bytes, counter: str
) -> None:
    honest, other = hall.caller(), hall.caller(said)
    for _ in range(3):
        hall.look()
    assert is_hung_up(other)
    assert getattr(hall.counters, counter) == 1
    honest.sendall(message(3))
    assert hall.look() == [[b"3"]]


def test_who_does_not_say_who_it_is_is_let_go(hall: Hall) -> None:
    silent, honest = hall.caller(b""), hall.caller()
    for _ in range(3):
        hall.look()
    hall.now += HANDSHAKE_S
    hall.look()
    assert is_hung_up(silent)
    assert hall.counters.strangers == 1
    honest.sendall(message(3))
    assert hall.look() == [[b"3"]]


def test_what_a_peer_does_not_fetch_waits_for_it_up_to_a_bound(hall: Hall) -> None:
    slow = hall.caller()
    hall.until_ready(1)
    (peer,) = hall.server._peers.values()
    body, sent = bytes(100_000), 0
    while len(peer.queue) < TERMS.queue:
        sent += 1
        hall.server.send(peer, zmtp.packed([b"%d" % sent, body]))
    for _ in range(50):
        hall.server.send(peer, zmtp.packed([b"lost", body]))
    assert len(peer.queue) == TERMS.queue
    slow.settimeout(0.01)
    reader = zmtp.Conversation(frozenset([b"ROUTER"]), len(body), 2)
    heard: list[bytes] = []
    for _ in range(1000):
        try:
            reader.take(slow.recv(1 << 20))
        except TimeoutError:
            if not peer.queue:
                break
        while (said := reader.next()) is not None:
            heard += said[:1]
        hall.look()
    assert heard == [b"%d" % n for n in range(1, sent + 1)], "in their order, and whole"


def test_who_begins_to_fetch_again_is_sent_a_few_at_a_time(hall: Hall) -> None:
    slow = hall.caller()
    hall.until_ready(1)
    (peer,) = hall.server._peers.values()
    while not peer.queue:
        hall.server.send(peer, bytes(10_000))
    peer.queue.extend([b"x"] * 100)
    while slow.recv(1 << 20, kernel.MSG_DONTWAIT | kernel.MSG_PEEK):
        slow.recv(1 << 20)
        waiting = len(peer.queue)
        hall.look()
        assert waiting - len(peer.queue) <= WRITES_PER_LOOK
        if not peer.queue:
            return


def test_a_ping_is_answered(hall: Hall) -> None:
    caller = hall.caller(HELLO + zmtp.packed([b"\x04PING\x00\x10abc"], zmtp.COMMAND))
    for _ in range(3):
        hall.look()
    answer = zmtp.hello(b"ROUTER") + zmtp.packed([b"\x04PONGabc"], zmtp.COMMAND)
    assert caller.recv(1000) == answer


def test_where_all_places_are_taken_the_process_with_most_of_them_gives_way(
    hall: Hall, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(server, "PEERS_MAX", 20)
    monkeypatch.setattr(server, "CROWD", 4)
    first = hall.caller()
    hall.until_ready(1)
    with crowd(hall.path, 30):
        for _ in range(4):
            hall.look()
        assert len(hall.server._peers) == 20
        assert hall.counters.crowded_out == 11
        hall.caller(HELLO + message(5))
        assert [[b"5"]] in (hall.look(), hall.look())
        first.sendall(message(6))
        assert hall.look() == [[b"6"]], "who was there is there still"
    assert [record.message for record in caplog.records] == [
        "hall: 20 are connected, and newcomers are turned away (no more are served)"
    ]


def test_whoever_comes_some_descriptors_are_left_to_others(tmp_path: Path) -> None:
    path = tmp_path / "x"
    with subprocess.Popen([sys.executable, "-c", LIMITED, str(path)], **PIPES) as limited:
        assert limited.stdout is not None
        limited.stdout.readline()
        with crowd(path, 110), crowd(path, 110):
            served, turned_away, opened = map(int, limited.communicate("\n")[0].split())
    assert served > 50
    assert turned_away > 0
    assert opened == SPARE


def test_a_file_that_vanishes_again_and_again_leaves_nothing_open(hall: Hall) -> None:
    there = hall.caller()
    hall.until_ready(1)
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    for times in range(1, 21):
        hall.path.unlink()
        hall.now += DOOR_S
        hall.look()
        assert hall.counters.bound_again == times
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208
    there.sendall(message(1))
    hall.caller(HELLO + message(2))
    deadline = time.monotonic() + 10.0
    heard: list[list[bytes]] = []
    while len(heard) < 2:
        assert time.monotonic() < deadline
        heard += hall.look()
    assert heard == [[b"1"], [b"2"]]
