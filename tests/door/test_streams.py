"""Subscribers at the door: newcomers, the slow, the silent, and those who send too much."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
import zmq

from taxeld.stream import topics
from taxeld.stream.sockets import open_socket

from ..rig.processes import attacked, free_port, resident_bytes
from ..rig.sockets import Sockets
from .stand import INFO, QUEUE, Stand, seq


@pytest.fixture(params=["ipc", "tcp"])
def stand(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stand]:
    """`stand.stream` is the endpoint of that kind, `stand.other` of the other."""
    with Stand(tmp_path, relay_publish=(f"tcp://127.0.0.1:{free_port()}",)) as made:
        if request.param == "tcp":
            made.stream, made.other = made.other, made.stream
        yield made


def test_each_subscriber_to_info_is_told_who_speaks_and_no_other(stand: Stand) -> None:
    other = stand.listener(b"/taxeld/estimate", b"/taxeld/information", b"/robot/")
    for prefix in (b"", b"/taxeld/info"):
        heard = stand.listener(prefix)
        while (parts := stand.received(heard))[0] != topics.INFO:
            pass
        assert msgpack.unpackb(parts[1]) == INFO
        assert float(parts[2]) == pytest.approx(time.time(), abs=60.0)
    for _ in range(100):  # again and again
        heard.setsockopt(zmq.UNSUBSCRIBE, topics.INFO)
        heard.setsockopt(zmq.SUBSCRIBE, topics.INFO)
    stand.received(heard)
    for _ in range(20):
        assert stand.received(other)[0] == topics.ESTIMATE


def test_the_loop_knows_which_topics_somebody_wants(stand: Stand) -> None:
    wants = stand.link.wants
    assert not any(map(wants, topics.TOPICS))
    first, second = (stand.listener(topics.TAXELS, b"/taxeld/p") for _ in range(2))
    stand.until(lambda: wants(topics.TAXELS) and wants(topics.PARTICLES))
    assert not wants(topics.HEALTH)
    stand.received(stand.listener(topics.INFO))  # the second is heard as well by now
    first.close()
    third = stand.listener(topics.COUNTS)
    stand.until(lambda: wants(topics.COUNTS))
    assert wants(topics.TAXELS)
    second.close()
    stand.until(lambda: not (wants(topics.TAXELS) or wants(topics.PARTICLES)))
    assert wants(topics.COUNTS)
    third.close()


@pytest.mark.parametrize("end", [b"\x00", b""])
def test_no_peer_ends_the_topic_of_another(stand: Stand, end: bytes) -> None:
    honest = stand.listener(topics.TAXELS)
    stand.until(lambda: stand.link.wants(topics.TAXELS))
    stranger = stand.socket(zmq.XSUB, stand.stream)
    for said in (b"\x01" + topics.PARTICLES, end + topics.TAXELS, b"\x01" + topics.HEALTH):
        stranger.send(said)
    stand.until(lambda: stand.link.wants(topics.HEALTH))
    assert stand.link.wants(topics.TAXELS)
    stranger.close()
    stand.until(lambda: not stand.link.wants(topics.PARTICLES))
    stand.link.send(topics.TAXELS, {"z": []}, 1.0)
    stand.received(honest)


@pytest.mark.check
def test_a_slow_subscriber_keeps_a_bounded_number_and_loses_the_rest_alone(stand: Stand) -> None:
    stalled = stand.listener(b"/taxeld/e", RCVHWM=1, RCVBUF=4096)
    reading = stand.listener(b"/taxeld/e")
    stand.received(stalled)
    stand.received(reading)
    body, sent = {"blob": "x" * 700}, 1000
    for number in range(sent):
        stand.link.send(topics.ESTIMATE, body | {"number": number}, 1.0)
        while msgpack.unpackb(stand.received(reading)[1]).get("number") != number:
            pass
    kept = 0
    while stalled.poll(200):
        kept += "number" in msgpack.unpackb(stalled.recv_multipart()[1])
    in_kernel = 2 * 212_992 // 700  # of both ends
    assert QUEUE <= kept < 2 * QUEUE + in_kernel


@pytest.mark.parametrize("kind", [zmq.XPUB, zmq.ROUTER])
def test_who_sends_too_large_a_frame_is_hung_up_on(tmp_path: Path, kind: int) -> None:
    with Sockets() as sockets:
        server = sockets.keep(open_socket(sockets.context, kind, send=10, receive=10, largest=1024))
        server.bind(f"ipc://{tmp_path}/x")
        events = sockets.keep(server.get_monitor_socket(zmq.EVENT_DISCONNECTED))
        client = sockets.open(zmq.XSUB if kind == zmq.XPUB else zmq.DEALER)
        client.connect(f"ipc://{tmp_path}/x")
        client.send(b"\x01" + b"x" * 1024)
        assert events.poll(10_000), "nobody was disconnected"
        assert not server.poll(0)


@pytest.mark.parametrize(
    ("attack", "copies", "estimates"),
    [
        ("subscribe_and_leave", 1, 100),
        pytest.param("subscribe_and_leave", 3, 600, marks=pytest.mark.check),
        pytest.param("endless_to_stream", 3, 600, marks=pytest.mark.check),
        pytest.param("unique_subscriptions", 3, 600, marks=pytest.mark.check),
    ],
)
def test_a_flood_costs_those_who_come_by_the_other_door_no_estimate(
    stand: Stand, attack: str, copies: int, estimates: int
) -> None:
    honest, flooded = (
        stand.listener(topics.ESTIMATE, endpoint=at) for at in (stand.stream, stand.other)
    )
    stand.received(flooded)
    first = seq(stand.received(honest))
    with contextlib.ExitStack() as flood:
        for _ in range(copies):
            flood.enter_context(attacked(attack, stand.other))
        heard = [seq(stand.received(honest)) for _ in range(estimates)]
    assert heard == list(range(first + 1, first + 1 + estimates))
    came = 0
    while seq(stand.received(flooded)) < heard[-1]:
        came += 1
    # `pytest -rP` shows it
    print(f"{copies} × {attack}: {1 - came / estimates:.0%} lost at that door")  # noqa: T201


MOST_BYTES = 160 << 20
ESTIMATES = 20  # that an honest subscriber hears meanwhile


@pytest.mark.parametrize(
    ("attack", "endpoint", "copies"),
    [("shut", "ipc://{}/stream", 1), ("requests", "ipc://{}/control", 2)],
)
def test_an_attack_costs_neither_the_door_nor_honest_peers_anything(
    tmp_path: Path, attack: str, endpoint: str, copies: int
) -> None:
    with Stand(tmp_path) as stand:
        door, honest = stand.pid, stand.listener(b"/taxeld/e")
        stand.received(honest)
        lost = stand.losses(honest)
        for _ in range(copies):
            stand.enter_context(attacked(attack, endpoint.format(tmp_path)))
        for _ in range(ESTIMATES):
            stand.received(honest)
        assert stand.answer({"cmd": "info"})["ok"]
        stand.received(stand.listener(b"/taxeld/e"))
        assert resident_bytes(door) < MOST_BYTES
        assert stand.pid == door
        assert not lost.poll(0)
