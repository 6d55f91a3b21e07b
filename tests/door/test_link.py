"""The loop's end of the pair: what a door says is done, within bounds of time and number."""

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.stream import pair, topics
from taxeld.stream.link import PACKETS_PER_LOOK, SILENT_S, START_S, Report
from taxeld.stream.pair import Kind

from .stand import INFO, Loop

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
