"""The publisher and whoever subscribes: newcomers, the slow, the silent and the flooding."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld import messages, streams
from taxeld.config import CurveConfig
from taxeld.curve import Guard
from taxeld.streams import Publisher

from .conftest import Sockets

INFO = {"taxeld": "0"}
QUEUE = 100


class Desk:
    """A publisher on a clock of its own, a tick of 10 ms at a time."""

    def __init__(self, sockets: Sockets, place: Path) -> None:
        self.endpoint = f"ipc://{place}/stream"
        self.now = 0.0
        self._sockets = sockets
        guard = Guard(sockets.context, None, CurveConfig())
        self.publisher = Publisher(sockets.context, QUEUE, INFO, guard)
        sockets.callback(self.publisher.close)
        self.publisher.bind((self.endpoint,))

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

    def until_wanted(self, topic: bytes, wanted: bool = True) -> None:
        deadline = time.monotonic() + 10.0
        while self.publisher.wants(topic) != wanted:
            assert time.monotonic() < deadline, f"{topic!r} stays {not wanted}"
            self.tick()
            time.sleep(0.001)


@pytest.fixture
def desk(sockets: Sockets, tmp_path: Path) -> Iterator[Desk]:
    return Desk(sockets, tmp_path)


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


def test_very_many_at_once_are_told_together(desk: Desk) -> None:
    many = [desk.subscriber(b"/taxeld/") for _ in range(60)]
    for socket in many:
        desk.until(socket)
    told = 1
    while many[0].poll(0):
        many[0].recv_multipart()
        told += 1
    assert told < 20, "one greeting serves all who came in a tenth of a second"


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
    second.setsockopt(zmq.UNSUBSCRIBE, b"/taxeld/p")
    desk.until_wanted(messages.PARTICLES, wanted=False)


@pytest.mark.parametrize("same", [True, False])
def test_a_flood_of_subscriptions_is_heard_a_bounded_number_a_tick(
    desk: Desk, sockets: Sockets, same: bool
) -> None:
    flooder = sockets.open(zmq.XSUB)
    flooder.connect(desk.endpoint)
    honest = desk.subscriber(b"/taxeld/info")
    events = 0
    desk.until(honest)
    outlet = next(iter(desk.publisher._outlets.values()))
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
    assert len(outlet._prefixes) == 1, "what is none of our topics is not kept"
    greetings = 0
    while honest.poll(0):
        honest.recv_multipart()
        greetings += 1
    assert greetings <= 1 + 200 * 0.01 / streams.INFO_S, "nobody is greeted to death"


def test_who_fetches_nothing_keeps_a_second_and_loses_the_rest_alone(desk: Desk) -> None:
    stalled, reading = desk.subscriber(b"/taxeld/e", queue=1), desk.subscriber(b"/taxeld/e")
    desk.until_wanted(messages.ESTIMATE)
    body = {"blob": [0.0] * 4000}  # 36 kB: sockets of the kernel hold few
    while not (stalled.poll(0) and reading.poll(0)):
        desk.publisher.send(messages.ESTIMATE, body, 1.0)
        time.sleep(0.002)
    while reading.poll(50):
        reading.recv_multipart()
    for _ in range(4 * QUEUE):
        desk.publisher.send(messages.ESTIMATE, body, 1.0)
        assert reading.poll(10_000), "the other gets every one"
        reading.recv_multipart()
    kept = 0
    while stalled.poll(50):
        stalled.recv_multipart()
        kept += 1
    assert QUEUE <= kept < 2 * QUEUE
