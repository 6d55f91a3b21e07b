"""The publisher and whoever subscribes, on this machine and over TCP: newcomers, the slow, the
silent and the flooding."""

import contextlib
import stat
import time
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.stream import messages
from taxeld.stream.local_stream import EVENTS_PER_LOOK, LocalStream
from taxeld.stream.network_stream import INFO_S
from taxeld.stream.publisher import Publisher
from taxeld.stream.subscriptions import EVENTS_MAX

from .conftest import Sockets
from .crowd import greeted
from .test_curve import free_port

INFO = {"taxeld": "0"}
QUEUE = 100


class Desk:
    """A publisher on a clock of its own, a tick of 10 ms at a time."""

    def __init__(self, sockets: Sockets, endpoint: str) -> None:
        self.endpoint = endpoint
        self.is_local = endpoint.startswith("ipc:")
        self.now = 0.0
        self._sockets = sockets
        self.publisher = Publisher(sockets.context, QUEUE, INFO)
        sockets.callback(self.publisher.close)
        self.publisher.bind((self.endpoint,), "publish.endpoints")

    def subscriber(self, *topics: bytes, queue: int = 1000) -> zmq.Socket[Any]:
        socket = self._sockets.open(zmq.SUB)
        socket.setsockopt(zmq.RCVHWM, queue)
        for topic in topics:
            socket.setsockopt(zmq.SUBSCRIBE, topic)
        socket.connect(self.endpoint)
        return socket

    def tick(self) -> None:
        self.now += 0.01
        self.publisher.greet(self.now, 1e9 + self.now)

    def until(self, socket: zmq.Socket[Any]) -> list[bytes]:
        """The next message of `socket`."""
        deadline = time.monotonic() + 10.0
        while not socket.poll(2):
            assert time.monotonic() < deadline, "nothing was published"
            self.tick()
        return socket.recv_multipart()

    def quiet(self, socket: zmq.Socket[Any]) -> bool:
        """Whether nothing comes to `socket` for a second of the desk's clock."""
        for _ in range(100):
            self.tick()
        return not socket.poll(50)

    def until_there(self, socket: zmq.Socket[Any], seconds: float = 10.0) -> bool:
        """Whether something comes; ticks go on, as what is queued leaves with them."""
        deadline = time.monotonic() + seconds
        while not socket.poll(1):
            if time.monotonic() > deadline:
                return False
            self.tick()
        return True

    def until_wanted(self, topic: bytes, wanted: bool = True) -> None:
        deadline = time.monotonic() + 10.0
        while self.publisher.wants(topic) != wanted:
            assert time.monotonic() < deadline, f"{topic!r} stays {not wanted}"
            self.tick()
            time.sleep(0.001)


@pytest.fixture(params=["ipc", "tcp"])
def desk(request: pytest.FixtureRequest, sockets: Sockets, tmp_path: Path) -> Desk:
    if request.param == "ipc":
        return Desk(sockets, f"ipc://{tmp_path}/stream")
    return Desk(sockets, f"tcp://127.0.0.1:{free_port()}")


@pytest.fixture
def local(sockets: Sockets, tmp_path: Path) -> Desk:
    return Desk(sockets, f"ipc://{tmp_path}/stream")


@pytest.mark.parametrize("prefix", [b"", b"/", b"/taxeld/", b"/taxeld/info"])
def test_whoever_subscribes_to_info_by_any_prefix_is_told_who_speaks(
    desk: Desk, prefix: bytes
) -> None:
    topic, body, stamp = desk.until(desk.subscriber(prefix))
    assert topic == messages.INFO
    assert msgpack.unpackb(body) == INFO
    assert float(stamp) == pytest.approx(1e9, abs=60.0)


def test_who_wants_other_topics_is_not(desk: Desk) -> None:
    other = desk.subscriber(b"/taxeld/estimate", b"/taxeld/information", b"/robot/")
    desk.until_wanted(messages.ESTIMATE)
    assert desk.quiet(other)


def test_late_joiners_and_who_subscribes_again_are_told(desk: Desk) -> None:
    first = desk.subscriber(b"")
    desk.until(first)
    second = desk.subscriber(b"")
    desk.until(second)
    assert desk.quiet(second)
    second.setsockopt(zmq.UNSUBSCRIBE, b"")
    second.setsockopt(zmq.SUBSCRIBE, messages.INFO)
    desk.until(second)


def test_very_many_at_once_are_all_told_and_none_of_them_again_and_again(desk: Desk) -> None:
    many = [desk.subscriber(b"/taxeld/") for _ in range(60)]
    for socket in many:
        desk.until(socket)
    told = 1
    while many[0].poll(20):
        many[0].recv_multipart()
        told += 1
    assert told == 1 if desk.is_local else told < 20


def test_what_nobody_wants_is_known(desk: Desk) -> None:
    desk.tick()
    assert not any(map(desk.publisher.wants, messages.TOPICS))
    first, second = desk.subscriber(messages.TAXELS), desk.subscriber(b"/taxeld/p")
    desk.until_wanted(messages.TAXELS)
    desk.until_wanted(messages.PARTICLES)
    assert not desk.publisher.wants(messages.HEALTH)
    first.close()
    desk.until_wanted(messages.TAXELS, wanted=False)
    assert desk.publisher.wants(messages.PARTICLES)
    second.close()
    desk.until_wanted(messages.PARTICLES, wanted=False)


@pytest.mark.parametrize("end", [b"\x00", b"\x02", b"", b"\xff"])
def test_what_one_peer_says_ends_no_other_peers_topic(
    desk: Desk, sockets: Sockets, end: bytes
) -> None:
    honest = desk.subscriber(messages.TAXELS)
    desk.until_wanted(messages.TAXELS)
    stranger = sockets.open(zmq.XSUB)
    stranger.connect(desk.endpoint)
    stranger.send(b"\x01" + messages.PARTICLES)
    stranger.send(end + messages.TAXELS)
    stranger.send(b"\x01" + messages.HEALTH)
    desk.until_wanted(messages.HEALTH)
    assert desk.publisher.wants(messages.TAXELS)
    assert desk.publisher.counters.malformed == (end != b"\x00")
    stranger.close()
    desk.until_wanted(messages.PARTICLES, wanted=False)
    desk.publisher.send(messages.TAXELS, {"z": []}, 1.0)
    assert honest.poll(10_000)


@pytest.mark.parametrize("same", [True, False])
def test_a_flood_of_subscriptions_is_heard_a_bounded_number_a_tick(
    desk: Desk, sockets: Sockets, same: bool
) -> None:
    flooder = sockets.open(zmq.XSUB)
    flooder.connect(desk.endpoint)
    honest = desk.subscriber(b"/taxeld/info")
    events = 0
    desk.until(honest)
    for k in range(200):
        for n in range(200):
            topic = b"/taxeld/info" if same else b"/taxeld/i%d" % (200 * k + n)
            try:
                flooder.send(b"\x01" + topic, zmq.NOBLOCK)
                events += 1
            except zmq.Again:
                break
        desk.tick()
    assert events > 1000
    (outlet,) = desk.publisher._outlets
    kept = (
        [s.prefixes for s in outlet._subscribers.values()]
        if isinstance(outlet, LocalStream)
        else [outlet._prefixes]  # type: ignore[attr-defined]
    )
    assert all(prefixes <= {b"/taxeld/info"} for prefixes in kept), "of others none is kept"
    assert desk.publisher.counters.hung_up >= 1, "who floods is hung up on"
    greetings = 0
    while honest.poll(0):
        honest.recv_multipart()
        greetings += 1
    assert greetings <= 1 + 200 * 0.01 / INFO_S, "nobody is greeted to death"


def test_whoever_floods_a_tick_hears_few_and_they_are_hung_up_on(
    local: Desk, tmp_path: Path
) -> None:
    flood = b"".join(b"\x00\x12\x01none of ours %04d" % n for n in range(4000))
    with greeted(tmp_path / "stream", b"SUB", 10, local.tick) as flooders:
        for flooder in flooders:
            with contextlib.suppress(BlockingIOError):
                flooder.sendall(flood)
        counters, deadline = local.publisher.counters, time.monotonic() + 10.0
        while counters.hung_up < 10:
            assert time.monotonic() < deadline
            before = counters.foreign
            local.tick()
            assert counters.foreign - before <= EVENTS_PER_LOOK
        assert counters.foreign <= 10 * EVENTS_MAX


def test_who_fetches_nothing_keeps_a_second_and_loses_the_rest_alone(desk: Desk) -> None:
    stalled, reading = desk.subscriber(b"/taxeld/e", queue=1), desk.subscriber(b"/taxeld/e")
    desk.until_wanted(messages.ESTIMATE)
    body = {"blob": [0.0] * 4000}  # 36 kB: sockets of the kernel hold few
    while not (stalled.poll(0) and reading.poll(0)):
        desk.publisher.send(messages.ESTIMATE, body, 1.0)
        desk.tick()
        time.sleep(0.002)
    while desk.until_there(reading, 0.05):
        reading.recv_multipart()
    for _ in range(4 * QUEUE):
        desk.publisher.send(messages.ESTIMATE, body, 1.0)
        assert desk.until_there(reading), "the other gets every one"
        reading.recv_multipart()
    kept = 0
    while desk.until_there(stalled, 0.5):
        stalled.recv_multipart()
        kept += 1
    assert QUEUE <= kept < 2 * QUEUE


def test_who_asks_for_very_many_topics_is_hung_up_on_and_nobody_else(
    desk: Desk, sockets: Sockets
) -> None:
    honest = desk.subscriber(b"/taxeld/e")
    desk.until_wanted(messages.ESTIMATE)
    flooder = sockets.open(zmq.XSUB)
    events = sockets.keep(flooder.get_monitor_socket(zmq.EVENT_DISCONNECTED))
    flooder.connect(desk.endpoint)
    lost = sockets.keep(honest.get_monitor_socket(zmq.EVENT_DISCONNECTED))
    for n in range(20 * EVENTS_MAX):
        if events.poll(0):
            break
        with contextlib.suppress(zmq.Again):
            flooder.send(b"\x01none of ours %d" % n, zmq.NOBLOCK)
        desk.tick()
        desk.publisher.send(messages.ESTIMATE, {"n": n}, 1.0)
        assert honest.poll(10_000)
        assert msgpack.unpackb(honest.recv_multipart()[1]) == {"n": n}, "not one is missed"
    assert events.poll(10_000), "the flooder was left alone"
    assert desk.publisher.counters.foreign >= EVENTS_MAX
    assert desk.publisher.counters.hung_up == 1
    assert not lost.poll(0)


def test_a_socket_file_that_vanished_is_bound_again_and_that_is_said_once(
    local: Desk, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = local.subscriber(b"/taxeld/e")
    local.until_wanted(messages.ESTIMATE)
    (tmp_path / "stream").unlink()
    local.until(local.subscriber(messages.INFO))
    for _ in range(1000):
        local.tick()
    assert [record.message for record in caplog.records] == [
        f"publish.endpoints: {tmp_path}/stream had vanished and was bound again"
    ]
    assert stat.S_IMODE((tmp_path / "stream").stat().st_mode) == 0o660
    assert local.publisher.counters.bound_again == 1
    local.publisher.send(messages.ESTIMATE, {}, 1.0)
    assert before.poll(10_000), "who was there has stayed connected"


def test_a_socket_file_that_another_has_taken_is_left_to_it(
    local: Desk, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "stream").unlink()
    (tmp_path / "stream").write_text("another's", encoding="ascii")
    for _ in range(1000):
        local.tick()
    assert [record.message for record in caplog.records] == [
        f"publish.endpoints: {tmp_path}/stream is lost: something else stands in its place"
    ]
    local.publisher.close()
    assert (tmp_path / "stream").read_text(encoding="ascii") == "another's"
