"""Subscribers at the door: newcomers, the slow, the silent and the flooding."""

import contextlib
import os
import select
import socket as kernel
import stat
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
import zmq

from taxeld.door.settings import Settings
from taxeld.door.streams import EVENTS_MAX
from taxeld.service.doorkeeper import Doorkeeper
from taxeld.stream import topics
from taxeld.stream.link import Link

from . import attacks
from .stand import INFO, PATIENCE_S, QUEUE, Stand, free_port, program, resident_bytes


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


def hello(path: Path) -> kernel.socket:
    """A subscriber by hand, after both sides have said who they are."""
    ready = b"\x05READY\x0bSocket-Type" + struct.pack(">I", 3) + b"SUB"
    made = kernel.socket(kernel.AF_UNIX)
    made.connect(str(path))
    made.sendall(
        b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48) + bytes((4, len(ready))) + ready
    )
    said = b""
    while b"XPUB" not in said:
        said += made.recv(4096)
    return made


@pytest.mark.parametrize("prefix", [b"", b"/", b"/taxeld/", b"/taxeld/info"])
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


def test_a_subscriber_that_comes_before_the_loop_is_told_once_the_loop_has_spoken(
    tmp_path: Path,
) -> None:
    served = Settings((f"ipc://{tmp_path}/stream",), "", "", "", QUEUE)
    with contextlib.ExitStack() as opened:
        keeper = opened.enter_context(contextlib.closing(Doorkeeper(served)))
        link = Link(INFO, lambda *_: None, {})
        opened.callback(link.detach)
        heard = opened.enter_context(opened.enter_context(zmq.Context()).socket(zmq.SUB))
        heard.setsockopt(zmq.SUBSCRIBE, topics.INFO)
        heard.connect(served.publish[0])
        heard.poll(2000)  # nothing comes, as no loop has looked at the door
        keeper.wait(link)
        assert heard.poll(1000 * PATIENCE_S)
        assert msgpack.unpackb(heard.recv_multipart()[1]) == INFO


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


@pytest.mark.parametrize("end", [b"\x00", b"\x02", b"", b"\xff"])
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
    assert local.link.counters.unsent == 0


def test_a_slow_subscriber_keeps_a_bounded_number_and_loses_the_rest_alone(stand: Stand) -> None:
    stalled = stand.subscriber(b"/taxeld/e", RCVHWM=1, RCVBUF=4096)
    reading = stand.subscriber(b"/taxeld/e")
    stand.received(stalled)
    stand.received(reading)
    body, sent = {"blob": "x" * 700}, 600
    for number in range(sent):
        stand.link.send(topics.ESTIMATE, body | {"number": number}, 1.0)
        while msgpack.unpackb(stand.received(reading)[1]).get("number") != number:
            pass
    kept = 0
    while stalled.poll(200):
        kept += "number" in msgpack.unpackb(stalled.recv_multipart()[1])
    in_kernel = 2 * 65_536 // 700  # of both ends
    assert QUEUE <= kept < 2 * QUEUE + in_kernel


def test_a_peer_that_asks_for_very_many_topics_is_hung_up_on_and_nobody_else(stand: Stand) -> None:
    honest = stand.subscriber(b"/taxeld/e")
    stand.until(lambda: stand.link.wants(topics.ESTIMATE))
    flooder = stand.socket(zmq.XSUB)
    events = stand.losses(flooder)
    flooder.connect(stand.stream)
    lost = stand.losses(honest)
    for number in range(20 * EVENTS_MAX):
        if events.poll(0):
            break
        with contextlib.suppress(zmq.Again):
            flooder.send(b"\x01none of ours %d" % number, zmq.NOBLOCK)
        stand.look()
    stand.until(lambda: events.poll(0))
    stand.until(lambda: stand.link.report.subscribers.hung_up)
    assert not lost.poll(0)
    stand.received(honest)


def test_a_socket_file_that_vanished_is_bound_again_and_that_is_said_once(
    local: Stand, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = local.subscriber(b"/taxeld/e")
    local.received(before)
    (tmp_path / "stream").unlink()
    local.until((tmp_path / "stream").exists)
    local.received(local.subscriber(topics.INFO))
    local.until(lambda: local.link.report.subscribers.bound_again == 1)
    assert [record.message for record in caplog.records] == [
        f"door: publish.endpoints: {tmp_path}/stream had vanished and was bound again"
    ]
    assert stat.S_IMODE((tmp_path / "stream").stat().st_mode) == 0o660
    local.received(before)


def test_a_socket_file_that_another_has_taken_is_left_to_it(
    local: Stand, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "stream").unlink()
    (tmp_path / "stream").write_text("another's", encoding="ascii")
    local.until(lambda: caplog.records)
    assert caplog.records[0].message.endswith("something else stands in its place")
    local.link.detach()
    local.keeper.close()
    assert (tmp_path / "stream").read_text(encoding="ascii") == "another's"


def test_a_peer_that_shuts_its_reading_side_ends_nothing(local: Stand, tmp_path: Path) -> None:
    """Its next message finds a broken pipe, between two events of the same connection."""
    honest = local.subscriber(b"/taxeld/e")
    door = local.pid
    for _ in range(10):
        with hello(tmp_path / "stream") as peer:
            peer.sendall(b"\x00\x0a\x01/taxeld/e")
            local.until(lambda peer=peer: can_read(peer))
            peer.sendall(b"\x00")
            peer.shutdown(kernel.SHUT_RD)
            local.received(honest)
    assert local.pid == door


def can_read(peer: kernel.socket) -> bool:
    return bool(select.select([peer], [], [], 0)[0])


def test_a_descriptor_that_lingers_stops_nothing(local: Stand, tmp_path: Path) -> None:
    """Closing it would wait for seconds, inside the process that it was passed to."""
    honest = local.subscriber(b"/taxeld/e")
    local.received(honest)
    with program(attacks.LINGER, tmp_path / "stream"):
        if tuple(map(int, os.uname().release.split(".")[:2])) < (6, 16):
            pytest.skip("before Linux 6.16 the door cannot refuse it; the loop is not concerned")
        for _ in range(40):
            local.received(honest)
    with (
        hello(tmp_path / "stream") as peer,
        kernel.socket() as passed,
        pytest.raises(PermissionError),
    ):
        kernel.send_fds(peer, [b"\0"], [passed.fileno()])


def test_a_message_without_end_costs_its_sender_the_connection(
    local: Stand, tmp_path: Path
) -> None:
    honest = local.subscriber(b"/taxeld/e")
    local.received(honest)
    door, lost = local.pid, local.losses(honest)
    with program(attacks.HOARD, tmp_path / "stream"):
        local.until(lambda: local.link.report.hoarders >= 3)
        assert resident_bytes(door) < 160 << 20
        local.received(honest)
    assert local.pid == door
    assert not lost.poll(0)


def test_newcomers_who_ask_again_and_again_make_the_door_no_larger(
    local: Stand, tmp_path: Path
) -> None:
    peers = [hello(tmp_path / "stream") for _ in range(50)]
    before = resident_bytes(local.pid)
    for _ in range(100):
        for peer in peers:
            with contextlib.suppress(BlockingIOError, BrokenPipeError):
                peer.sendall(b"\x00\x0d\x01/taxeld/info")
        local.look()
    for _ in range(100):
        local.look()
        time.sleep(0.01)
    assert resident_bytes(local.pid) - before < 30 << 20
    for peer in peers:
        peer.close()
