"""Subscribers at the door: newcomers, the slow and the silent."""

import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
import zmq

from taxeld.stream import topics

from ..rig.processes import free_port
from .stand import INFO, QUEUE, Stand


@pytest.fixture(params=["ipc", "tcp"])
def stand(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stand]:
    """`stand.stream` is the endpoint of that kind."""
    tcp = f"tcp://127.0.0.1:{free_port()}"
    with Stand(tmp_path, relay_publish=(tcp,)) as made:
        if request.param == "tcp":
            made.stream = tcp
        yield made


@pytest.fixture
def local(tmp_path: Path) -> Iterator[Stand]:
    with Stand(tmp_path) as made:
        yield made


@pytest.mark.parametrize("prefix", [b"", b"/taxeld/info"])
def test_a_subscriber_to_info_by_any_prefix_is_told_who_speaks(stand: Stand, prefix: bytes) -> None:
    heard = stand.subscriber(prefix)
    while (parts := stand.received(heard))[0] != topics.INFO:
        pass
    assert msgpack.unpackb(parts[1]) == INFO
    assert float(parts[2]) == pytest.approx(time.time(), abs=60.0)


def test_a_subscriber_to_other_topics_is_not_told(stand: Stand) -> None:
    other = stand.subscriber(b"/taxeld/estimate", b"/taxeld/information", b"/robot/")
    stand.until(lambda: stand.link.wants(topics.ESTIMATE))
    for _ in range(20):
        assert stand.received(other)[0] == topics.ESTIMATE


def test_late_joiners_and_who_subscribes_again_are_told(stand: Stand) -> None:
    first, second = stand.subscriber(topics.INFO), stand.subscriber(topics.INFO)
    stand.received(first)
    stand.received(second)
    second.setsockopt(zmq.UNSUBSCRIBE, topics.INFO)
    second.setsockopt(zmq.SUBSCRIBE, b"/taxeld/i")
    stand.received(second)


def test_the_loop_knows_which_topics_somebody_wants(stand: Stand) -> None:
    assert not any(map(stand.link.wants, topics.TOPICS))
    first, second = stand.subscriber(topics.TAXELS), stand.subscriber(b"/taxeld/p")
    wants = stand.link.wants
    stand.until(lambda: wants(topics.TAXELS) and wants(topics.PARTICLES))
    assert not wants(topics.HEALTH)
    first.close()
    stand.until(lambda: not wants(topics.TAXELS))
    assert wants(topics.PARTICLES)
    second.close()
    stand.until(lambda: not wants(topics.PARTICLES))


@pytest.mark.parametrize("end", [b"\x00", b""])
def test_no_peer_ends_the_topic_of_another(stand: Stand, end: bytes) -> None:
    honest = stand.subscriber(topics.TAXELS)
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


def test_a_message_of_any_size_goes_out_whole(local: Stand) -> None:
    """A hundred thousand particles are 3.6 MB, more than the pair takes as one packet."""
    cloud = {"xytheta": [[0.1, 0.2, 0.3]] * 100_000}
    heard = local.subscriber(topics.PARTICLES)
    local.until(lambda: local.link.wants(topics.PARTICLES))
    local.link.send(topics.PARTICLES, cloud, 1.0)
    assert msgpack.unpackb(local.received(heard)[1]) == cloud
    assert local.link.unsent == 0


@pytest.mark.check
def test_a_slow_subscriber_keeps_a_bounded_number_and_loses_the_rest_alone(stand: Stand) -> None:
    stalled = stand.subscriber(b"/taxeld/e", RCVHWM=1, RCVBUF=4096)
    reading = stand.subscriber(b"/taxeld/e")
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
