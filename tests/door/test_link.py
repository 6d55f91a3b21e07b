"""The loop's end of the pair, and a door that may be hostile."""

import logging
import math
import socket
from collections.abc import Iterator
from dataclasses import asdict

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.stream import pair, topics
from taxeld.stream.link import CHANGES_HZ, PACKETS_HZ, REASON_MAX, SILENT_S, START_S, Link, Report
from taxeld.stream.pair import Kind


class Ends:
    """A link, and the door's end in the test's hands."""

    def __init__(self) -> None:
        self.poses: list[tuple[float, float, float, float]] = []
        self.done: list[str] = []
        changes = {name: lambda name=name: self.done.append(name) for name in ("tare", "reset")}
        self.link = Link({"taxeld": "0"}, lambda *pose: self.poses.append(pose), changes)
        self.now_s = 0.0
        self.door: socket.socket | None = None
        self.attach()

    def attach(self, *, ready: bool = True) -> None:
        self.close()
        loops, self.door = pair.open_pair()
        self.link.attach(loops, self.now_s)
        if ready:
            self.say(Kind.READY)
            self.link.look(self.now_s)

    def say(self, kind: int, body: bytes = b"") -> None:
        assert self.door is not None
        self.door.send(bytes((kind,)) + body)

    def look(self, after_s: float = 0.01) -> None:
        self.now_s += after_s
        self.link.look(self.now_s)

    def heard(self) -> list[tuple[int, bytes]]:
        """All that has come to the door."""
        assert self.door is not None
        found = []
        while (packet := pair.receive(self.door)) is not None:
            found.append(packet)
        return found

    def close(self) -> None:
        self.link.detach()
        if self.door is not None:
            self.door.close()


@pytest.fixture
def ends() -> Iterator[Ends]:
    made = Ends()
    yield made
    made.close()


def test_a_new_door_is_told_first_who_speaks(ends: Ends) -> None:
    ((kind, body),) = ends.heard()
    assert kind == Kind.MESSAGE
    assert pair.HEAD.unpack_from(body)[0] == topics.TOPICS.index(topics.INFO)
    assert msgpack.unpackb(body[pair.HEAD.size :]) == {"taxeld": "0"}


def test_poses_and_changes_reach_the_loop(ends: Ends) -> None:
    ends.heard()
    ends.say(Kind.POSES, pair.POSE.pack(1.0, 2.0, 3.0, 4.0) + pair.POSE.pack(5.0, 6.0, 7.0, 8.0))
    ends.say(Kind.CHANGE, pair.REQUEST.pack(7) + b"tare")
    ends.say(Kind.WANTED, bytes((1 << topics.TOPICS.index(topics.TAXELS),)))
    ends.look()
    assert ends.poses == [(1.0, 2.0, 3.0, 4.0), (5.0, 6.0, 7.0, 8.0)]
    assert ends.done == ["tare"]
    assert [t for t in topics.TOPICS if ends.link.wants(t)] == [topics.TAXELS]
    assert ends.heard() == [(Kind.ANSWER, pair.REQUEST.pack(7))]


def test_a_fault_is_heard_of_a_door_that_ends_without_reading(ends: Ends) -> None:
    ends.say(Kind.FAULT, b"no such key")
    assert ends.door is not None
    ends.door.close()
    ends.look()
    assert ends.link.fault == "no such key"
    assert ends.link.end is None


def test_the_door_is_asked_for_poses(ends: Ends) -> None:
    ends.heard()
    ends.link.ask_poses(also_next=True)
    ends.link.ask_poses(also_next=False)
    assert ends.heard() == [(Kind.ASK, b"\x01"), (Kind.ASK, b"\x00")]


def test_a_door_that_starts_gets_no_message_that_would_be_old_when_it_is_ready(ends: Ends) -> None:
    loops, starting = pair.open_pair()
    ends.link.attach(loops, ends.now_s)
    ends.link.send(topics.ESTIMATE, {"seq": 1}, 1.0)
    starting.send(bytes((Kind.READY,)))
    ends.look()
    ends.link.send(topics.ESTIMATE, {"seq": 2}, 1.0)
    sent = [pair.receive(starting), pair.receive(starting), pair.receive(starting)]
    assert sent[0] is not None
    assert sent[1] is not None
    assert msgpack.unpackb(sent[1][1][pair.HEAD.size :]) == {"seq": 2}
    assert sent[2] is None
    assert ends.link.unsent == 0
    starting.close()


@given(packets=st.lists(st.binary(min_size=1, max_size=5000), max_size=40))
def test_whatever_a_door_sends_the_loop_goes_on(packets: list[bytes]) -> None:
    ends = Ends()
    for packet in packets:
        ends.door.send(packet)
    ends.look()
    ends.say(Kind.POSES, pair.POSE.pack(1.0, 2.0, 3.0, 4.0))
    ends.look()
    assert ends.poses[-1] == (1.0, 2.0, 3.0, 4.0)
    ends.close()


REPORT = asdict(Report())


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        (Kind.POSES, b""),
        (Kind.POSES, b"\0" * 31),
        (Kind.POSES, pair.POSE.pack(1.0, 0.0, 0.0, 0.0) + pair.POSE.pack(1.0, 0.0, 0.0, math.nan)),
        (Kind.POSES, pair.POSE.pack(1.0, math.nan, 0.0, 0.0)),
        (Kind.POSES, pair.POSE.pack(math.inf, 0.0, 0.0, 0.0)),
        (Kind.CHANGE, pair.REQUEST.pack(1) + b"stop"),
        (Kind.CHANGE, b"\0"),
        (Kind.WANTED, b""),
        (Kind.REPORT, b"\x81"),
        (Kind.REPORT, msgpack.packb([])),
        (Kind.REPORT, msgpack.packb(REPORT | {"keys_refused": -1})),
        (Kind.REPORT, msgpack.packb(REPORT | {"keys_refused": 2**63})),
        (Kind.REPORT, msgpack.packb(REPORT | {"keys_refused": True})),
        (Kind.REPORT, msgpack.packb(REPORT | {"robot": {}})),
        (Kind.REPORT, msgpack.packb(REPORT | {"robot": REPORT["robot"] | {"reason": 1}})),
        (Kind.REPORT, msgpack.packb(REPORT | {"more": 1})),
        (Kind.LOG, b"\x09text"),
        (Kind.MESSAGE, b"x"),
        (99, b""),
    ],
    ids=str,
)
def test_a_packet_that_is_none_changes_nothing(ends: Ends, kind: int, body: bytes) -> None:
    before = asdict(ends.link.report)
    ends.say(kind, body)
    ends.look()
    assert (ends.poses, ends.done, asdict(ends.link.report)) == ([], [], before)


def test_lines_of_a_door_stay_one_line_each(ends: Ends, caplog: pytest.LogCaptureFixture) -> None:
    ends.say(Kind.LOG, b"\x01" + b"a\n<0>b\x1b]0;c" + b"x" * 3000)
    ends.look()
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.message.startswith("door: a\\n<0>b\\x1b]0;cxx")
    assert record.message.isprintable()
    assert len(record.message) < 600


def test_why_a_message_is_no_pose_stays_one_short_line(ends: Ends) -> None:
    robot = REPORT["robot"] | {"reason": "a\n<0>b\x1b]0;c" + "x" * 900}
    ends.say(Kind.REPORT, msgpack.packb(REPORT | {"robot": robot}))
    ends.look()
    reason = ends.link.report.robot.reason
    assert reason.startswith("a\\n<0>b\\x1b]0;cxx")
    assert reason.isprintable()
    assert len(reason) == REASON_MAX


def test_changes_beyond_a_rate_are_not_done_and_that_is_said(ends: Ends) -> None:
    ends.heard()
    for number in range(60):
        ends.say(Kind.CHANGE, pair.REQUEST.pack(number) + b"reset")
    ends.look()
    ends.look()
    assert len(ends.done) <= CHANGES_HZ + 1
    answers = [body for _, body in ends.heard()]
    assert len(answers) == 60
    assert answers[-1].endswith(b"a second are not done; ask again")


def test_a_door_that_sends_without_end_is_let_go(
    ends: Ends, caplog: pytest.LogCaptureFixture
) -> None:
    pose = pair.POSE.pack(1.0, 0.0, 0.0, 0.0)
    for _ in range(round(2 * PACKETS_HZ / 64)):
        for _ in range(64):
            ends.say(Kind.POSES, pose)
        ends.look(0.0001)
        if ends.link.end is None:
            break
    assert ends.link.end is None
    assert caplog.messages == ["door: sends without end"]


def test_a_door_that_says_nothing_is_let_go_but_not_because_the_loop_was_stopped(
    ends: Ends,
) -> None:
    ends.say(Kind.READY)
    ends.look()
    ends.look(60.0)
    assert ends.link.end is not None
    for _ in range(round(SILENT_S / 0.05)):
        ends.look(0.05)
    assert ends.link.end is None


def test_a_door_that_starts_slowly_is_waited_for(ends: Ends) -> None:
    ends.attach(ready=False)
    for _ in range(round(START_S / 0.05) - 1):
        ends.look(0.05)
    assert ends.link.end is not None
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


def test_without_a_door_nothing_is_sent_wanted_or_counted(ends: Ends) -> None:
    ends.say(Kind.WANTED, b"\x1f")
    ends.look()
    ends.door.close()
    ends.look()
    assert ends.link.end is None
    ends.link.send(topics.ESTIMATE, {}, 1.0)
    assert not any(map(ends.link.wants, topics.TOPICS))
    assert ends.link.unsent == 0
    ends.attach()
    assert ends.link.end is not None


def test_descriptors_that_a_door_passes_are_refused_where_the_kernel_can(ends: Ends) -> None:
    with socket.socket() as passed:
        try:
            socket.send_fds(ends.door, [b"x"], [passed.fileno()])
        except PermissionError:
            return
    with socket.socket() as probe, pytest.raises(OSError, match=r"."):
        probe.setsockopt(socket.SOL_SOCKET, pair.SO_PASSRIGHTS, 0)
