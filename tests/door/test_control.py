"""Requests at the door: each gets an answer, and only those who may change anything do."""

import contextlib
import grp
import logging
import os
import socket as kernel
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from taxeld.door.control import Control, for_members, packed_ok
from taxeld.door.process import Door
from taxeld.door.settings import Settings
from taxeld.stream import pair, topics
from taxeld.stream.link import PACKETS_PER_LOOK, SILENT_S, START_S, Report
from taxeld.stream.pair import Kind
from tests.rig.examples import examples

from ..rig.clocks import PATIENCE_S, Clock
from ..rig.processes import free_port
from .stand import INFO, Loop, Stand, needs_root, open_to_all


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Stand]:
    with Stand(tmp_path) as made:
        yield made


def test_status_and_info_are_the_last_messages_and_the_loop_does_changes(stand: Stand) -> None:
    assert stand.answer({"cmd": "info"}) == {"ok": True, "info": INFO}
    stand.link.send(topics.HEALTH, {"uptime_s": 1.0}, 1.0)
    stand.link.tell({"waits_for": "the device"})
    status = stand.answer({"cmd": "status"})
    assert status["ok"]
    assert status["health"] == {"uptime_s": 1.0}
    assert status["estimate"]["seq"] > 0
    assert status["waits_for"] == "the device"
    assert stand.answer({"cmd": "tare"}) == stand.answer({"cmd": "reset"}) == {"ok": True}
    assert stand.done == ["tare", "reset"]


KNOWN = "known: status, info, memory, tare, reset, prior"
PRIOR = {"cmd": "prior", "x": 0.1, "y": 0.2, "theta": 0.3, "cov": [0.02, 0.02, 0.1]}


def test_what_cannot_be_done_is_answered_in_a_line_and_a_prior_is_checked(stand: Stand) -> None:
    for request, error in (
        ({"cmd": "play"}, f"unknown cmd 'play'; {KNOWN}"),
        ({"cmd": "tare", "hard": 1}, "unknown key 'hard'; tare takes none"),
        ({}, "unknown cmd None"),
        ({"cmd": ["tare"]}, "unknown cmd ['tare']"),
        (PRIOR | {"object": "cup"}, "no object cup"),
        *((PRIOR | bad, "prior: ") for bad in ({"x": None}, {"cov": "wide"}, {"z": 1})),
    ):
        told = stand.answer(request)["error"]
        assert told.startswith(error)
        assert "\n" not in told
    assert stand.answer(PRIOR) == {"ok": True}
    assert [p.object for p in stand.priors] == ["cup", ""]
    assert stand.done == []


@pytest.mark.check
def test_a_loop_that_does_not_answer_is_said_to_the_client(stand: Stand) -> None:
    stand.until(lambda: stand.sent > 2)
    for command, error in (("tare", "the loop does not answer"), ("status", "the loop is silent")):
        asking = stand.socket(zmq.REQ, stand.control)
        asking.send(msgpack.packb({"cmd": command}))
        assert asking.poll(1000 * PATIENCE_S)
        assert msgpack.unpackb(asking.recv())["error"].startswith(error)


def test_a_door_that_was_slow_does_not_say_that_the_loop_is_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, (loop, end) = Clock(), pair.open_pair()
    with loop, end:
        monkeypatch.setattr("taxeld.door.process.time.monotonic", clock)
        door = Door(Settings(), end)
        pair.send(loop, Kind.MESSAGE, topics.ESTIMATE, 1.0, b"\x80")
        for silent in ("", "the loop is silent; the log of the daemon may say why"):
            clock.now += 10.0
            assert msgpack.unpackb(door._on_status()).get("error", "") == silent
        door.close()


DAEMON = grp.getgrgid(1).gr_name


@pytest.mark.skipif(needs_root[0], reason=needs_root[1])
@pytest.mark.parametrize(
    ("group", "groups", "refusal"),
    [
        (DAEMON, [1], ""),
        (DAEMON, [], f"is for members of the group {DAEMON}: sudo usermod -aG {DAEMON} USER"),
        ("nobodys", [1], "is for the daemon's own user, as there is no group nobodys here"),
    ],
    ids=["member", "other", "no group"],
)
def test_only_members_of_the_group_change_anything(
    tmp_path: Path, group: str, groups: list[int], refusal: str
) -> None:
    with Stand(tmp_path, change_group=group) as stand:
        open_to_all(tmp_path)
        status, tare = (stand.asked_by_another(command, groups) for command in ("status", "tare"))
    assert (status["ok"], tare["ok"]) == (True, not refusal)
    assert tare.get("error", "tare: ").startswith(f"tare: {refusal}")
    assert stand.done == ["tare"] * (not refusal)


BOMBS = [
    b"\x91" * 4000,
    b"\x81\xa1x" * 1000,
    b"\xdf\xff\xff\xff\xff",
    b"\xc7\x0c\xff" + b"\xff" * 12,
    msgpack.packb({"cmd": "info"}) + b"\x00",
    msgpack.packb({1: 2}),
]
PLAIN = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()


ANY = st.recursive(
    PLAIN | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text() | st.just("cmd"), inner),
    max_leaves=8,
)
BODY = ANY.map(msgpack.packb) | st.binary(max_size=64) | st.sampled_from(BOMBS)


@examples(60)
@given(envelope=st.lists(st.sampled_from([b"", b"x"]), max_size=6), body=BODY)
def test_no_request_ends_the_answers(envelope: list[bytes], body: bytes) -> None:
    with zmq.Context() as context, context.socket(zmq.DEALER) as asking:
        answers = {"status": packed_ok, "info": packed_ok}
        made = Control(context, answers, lambda *_: True, lambda _: "no")
        made.socket.bind("inproc://c")
        asking.setsockopt(zmq.LINGER, 0)
        asking.connect("inproc://c")
        asking.send_multipart([*envelope, body])
        made.socket.poll(10_000)
        made.poll(0.0)
        assert asking.poll(10_000)
        *back, answer = asking.recv_multipart()
        assert back == envelope
        assert isinstance(msgpack.unpackb(answer)["ok"], bool)
        made.socket.close()


def test_nobody_may_change_anything_by_the_descriptor_of_another_connection() -> None:
    """As a frame has it whose own connection was closed."""
    own, peer = kernel.socketpair()
    with own, peer:
        late = {zmq.SRCFD: own.fileno(), "Peer-Address": "localhost:65534:65534:1"}
        assert for_members("")(late).startswith("is for the daemon's own user")  # type: ignore[arg-type]


def test_over_tcp_nothing_is_changed_unless_that_is_configured(tmp_path: Path) -> None:
    for change in (False, True):
        tcp = f"tcp://127.0.0.1:{free_port()}"
        with Stand(tmp_path, relay_control=tcp, relay_change=change) as stand:
            assert stand.answer({"cmd": "info"}, tcp)["ok"]
            assert stand.answer({"cmd": "reset"}, tcp)["ok"] is change
            assert stand.done == ["reset"] * change


def test_the_command_line_client_outlives_a_door(stand: Stand) -> None:
    os.kill(stand.pid, 9)
    assert stand.asked_by_client("info", stand.control)["ok"]


POSE, CAME = [1.0, 2.0, 3.0, 4.0], 5.0


class Ends(contextlib.ExitStack, Loop):
    """A link, and the door's end in the test's hands."""

    def __init__(self) -> None:
        contextlib.ExitStack.__init__(self)
        Loop.__init__(self)
        self.callback(self.link.detach)
        self.now_s = 0.0
        self.attach()

    def attach(self, *, ready: bool = True) -> None:
        loops, door = pair.open_pair()
        self.door = self.enter_context(door)
        self.link.attach(loops, self.now_s)
        if ready:
            self.say(Kind.READY)
            self.link.look(self.now_s)

    def say(self, kind: Kind, *values: object) -> None:
        assert pair.send(self.door, kind, *values)

    def look(self, after_s: float = 0.01) -> None:
        self.now_s += after_s
        self.link.look(self.now_s)

    def heard(self) -> list[tuple[int, list[Any]]]:
        """All that has come to the door."""
        found = []
        while (packet := pair.receive(self.door)) is not None:
            found.append(packet)
        return found


@pytest.fixture
def ends() -> Iterator[Ends]:
    with Ends() as made:
        yield made


def test_what_a_door_says_is_done_and_it_is_told_first_who_speaks(ends: Ends) -> None:
    wanted = [b"/taxeld/%d" % number for number in range(20)]
    report = Report(keys_refused=3)
    report.robot.reason = "theta is no number"
    ends.say(Kind.POSES, [[POSE, [5.0, 6.0, 7.0, 8.0]], [POSE]], False, CAME)
    ends.say(Kind.CHANGE, 7, "tare", {})
    ends.say(Kind.WANTED, wanted)
    ends.say(Kind.REPORT, asdict(report))
    ends.look()
    ends.link.ask_poses(also_next=True)
    assert ends.poses == [(*POSE, CAME, 0), (5.0, 6.0, 7.0, 8.0, CAME, 0), (*POSE, CAME, 1)]
    assert ends.done == ["tare"]
    assert all(map(ends.link.wants, wanted))
    assert not ends.link.wants(topics.TAXELS)
    assert ends.link.report == report
    (kind, (topic, t, body)), *more = ends.heard()
    assert (kind, topic, t, msgpack.unpackb(body)) == (Kind.MESSAGE, topics.INFO, 0.0, INFO)
    assert more == [(Kind.ANSWER, [7, ""]), (Kind.ASK, [True])]


def test_a_change_that_fails_is_logged_counted_and_answered_and_the_door_stays(
    ends: Ends, caplog: pytest.LogCaptureFixture
) -> None:
    ends.heard()
    ends.say(Kind.CHANGE, 3, "fail", {})
    ends.say(Kind.CHANGE, 4, "reset", {})
    ends.look()
    failed = "it failed; the log of the daemon says where"
    assert ends.heard() == [(Kind.ANSWER, [3, failed]), (Kind.ANSWER, [4, ""])]
    (line,) = caplog.messages
    assert line.startswith("fail: failed at ")
    assert "ZeroDivisionError" in line
    assert "\n" not in line
    assert (ends.link.failed, ends.done) == (1, ["reset"])


def test_a_fault_is_heard_of_a_door_that_ends_without_reading(
    ends: Ends, caplog: pytest.LogCaptureFixture
) -> None:
    ends.say(Kind.WANTED, list(topics.TOPICS))
    ends.say(Kind.LOG, logging.WARNING, "a line")
    ends.say(Kind.FAULT, "no such key")
    ends.door.close()
    ends.look()
    assert (ends.link.fault, ends.link.end) == ("no such key", None)
    ends.link.send(topics.ESTIMATE, {}, 1.0)
    assert not any(map(ends.link.wants, topics.TOPICS))
    assert ends.link.unsent == 0
    assert caplog.record_tuples == [("taxeld.stream.link", logging.WARNING, "door: a line")]


def test_a_message_of_any_size_reaches_a_door_that_is_ready(ends: Ends) -> None:
    ends.attach(ready=False)
    ends.link.send(topics.ESTIMATE, {"seq": 1}, 1.0)  # it would be old
    ends.say(Kind.READY)
    ends.look()
    ends.heard()
    for size in (10, pair.PACKET_MAX - 60, pair.PACKET_MAX, 3_000_000):
        ends.link.send(topics.PARTICLES, {"x": bytes(size)}, 1.0)
        ((_, (_, _, body)),) = ends.heard()
        assert msgpack.unpackb(body) == {"x": bytes(size)}
    assert ends.link.unsent == 0


@given(packets=st.lists(st.binary(min_size=1, max_size=5000), max_size=40))
def test_a_packet_that_is_none_is_logged_and_counted_and_its_door_is_let_go(
    packets: list[bytes],
) -> None:
    with Ends() as ends:
        for packet in packets:
            ends.door.send(packet)
        ends.look()
        assert (ends.link.end is None) == (ends.link.failed > 0)
        ends.attach()
        ends.say(Kind.POSES, [[POSE]], False, CAME)
        ends.look()
        assert ends.poses[-1] == (*POSE, CAME, 0)


def test_of_a_door_that_says_much_a_look_takes_a_bounded_part(ends: Ends) -> None:
    said = PACKETS_PER_LOOK + 10
    for _ in range(said):
        ends.say(Kind.POSES, [[POSE]], False, CAME)
    ends.look()
    assert len(ends.poses) == PACKETS_PER_LOOK
    ends.look()
    assert len(ends.poses) == said


def test_a_door_that_says_nothing_is_let_go_but_not_because_the_loop_was_stopped(
    ends: Ends, caplog: pytest.LogCaptureFixture
) -> None:
    ends.look(60.0)
    assert ends.link.end is not None
    for _ in range(round(SILENT_S / 0.05)):
        ends.look(0.05)
    assert ends.link.end is None
    assert caplog.messages == ["door: hangs"]
    ends.attach(ready=False)  # one that starts slowly is waited for
    for _ in range(round(START_S / 0.05) - 1):
        ends.look(0.05)
    ends.say(Kind.READY)
    ends.look()
    assert ends.link.is_ready


def test_what_a_full_pair_does_not_take_is_dropped_and_counted(ends: Ends) -> None:
    for number in range(2000):
        ends.link.send(topics.ESTIMATE, {"number": number}, 1.0)
    lost = ends.link.unsent
    assert 0 < lost < 2000
    assert len(ends.heard()) == 1 + 2000 - lost
    ends.link.send(topics.ESTIMATE, {}, 1.0)
    assert len(ends.heard()) == 1
