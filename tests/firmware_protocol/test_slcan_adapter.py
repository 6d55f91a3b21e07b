"""The talk with SLCAN adapters that differ, on a clock of the test's own."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld_hil.rig import adapters
from taxeld_protocol.frames import Frame
from taxeld_protocol.slcan import BEL, SlcanReader, encode
from taxeld_protocol.slcan_adapter import ANSWER_S, Adapter

TICK_S = 0.01
SILENCE_S = 1.0
AGAIN_S = 2.0  # after a second's silence, at the latest
SCAN = Frame(0.0, 0x501, b"\x3c\x00\xd2")


class Talk:
    """A host and an adapter; the bus behind it has a frame every 50 ms unless it is told not to."""

    def __init__(
        self, far: adapters.Adapter, *, listen_only: bool = False, silence_s: float = SILENCE_S
    ) -> None:
        self.far = far
        self.host = Adapter(1_000_000, listen_only=listen_only, silence_s=silence_s)
        self.reader = SlcanReader()
        self.now_s = 0.0
        self.bus_period_s = 0.05
        self.delay_s = 0.0  # of each answer
        self.deaf_until_s = 0.0
        self.wrote: list[bytes] = []
        self._on_way: list[tuple[float, bytes]] = []
        self._bus_s = 0.0

    def run(self, seconds: float) -> None:
        self.until(lambda: False, seconds)

    def until(self, true: Callable[[], bool], within_s: float) -> float:
        """→ how long it took, or `within_s`."""
        began_s = self.now_s
        while not true() and self.now_s < began_s + within_s:
            self._tick()
        return self.now_s - began_s

    def frame(self, line: bytes) -> None:
        """A request of the host's."""
        self.host.sent(line, self.now_s)
        self._give(line)

    def _tick(self) -> None:
        self.now_s += TICK_S
        due = [data for at, data in self._on_way if at <= self.now_s]
        self._on_way = [(at, data) for at, data in self._on_way if at > self.now_s]
        if self.now_s >= self._bus_s:
            self._bus_s = self.now_s + self.bus_period_s
            due.append(self.far.bus(SCAN._replace(t=self.now_s)))
        lines = self.reader.lines(b"".join(due))
        self.host.hear(lines)
        self.reader.frames(lines, self.now_s)
        self._give(self.host.due(self.now_s))

    def _give(self, data: bytes) -> None:
        lines = data.split(b"\r")[:-1]
        self.wrote += lines
        for line in lines if self.now_s >= self.deaf_until_s else ():
            answer, _ = self.far.host(line, self.now_s)
            self._on_way.append((self.now_s + self.delay_s, answer))


kinds = pytest.mark.parametrize("kind", adapters.KINDS)
both_ways = pytest.mark.parametrize("listen_only", [False, True])


@kinds
@both_ways
def test_each_kind_of_adapter_is_opened_at_the_bit_rate_and_listens_where_it_should(
    kind: str, listen_only: bool
) -> None:
    talk = Talk(adapters.Adapter(kind), listen_only=listen_only)
    talk.run(SILENCE_S)
    assert talk.far.on_bus
    assert talk.far.is_silent == listen_only
    assert talk.host.is_open
    assert (talk.host.refused, talk.host.complaints, talk.host.silences) == (0, [], 0)
    assert talk.reader.counters.frames > 0
    assert talk.reader.counters.noise == 0


@kinds
@pytest.mark.parametrize("left", [[b"S4"], [b"S4", b"O"], [b"S8", b"L"], [b"S8", b"M1", b"O"]])
def test_an_adapter_is_opened_whatever_another_host_left_behind(
    kind: str, left: list[bytes]
) -> None:
    far = adapters.Adapter(kind)
    for line in left:
        far.host(line)
    talk = Talk(far)
    talk.run(SILENCE_S)
    assert (far.on_bus, far.is_silent) == (True, False)
    assert talk.host.complaints == []


@kinds
def test_an_adapter_is_opened_though_a_host_that_died_left_half_a_line(kind: str) -> None:
    far = adapters.Adapter(kind)
    for line in (b"S4", b"O"):
        far.host(line)
    talk = Talk(far)
    begun = [b"t1018AB"]
    give = talk._give
    talk._give = lambda data: give((begun.pop() if begun else b"") + data)  # type: ignore[method-assign]
    talk.run(SILENCE_S)
    assert far.on_bus
    assert talk.wrote[0] == b"t1018ABC"


@kinds
@both_ways
def test_a_channel_that_another_closed_is_opened_again_within_two_seconds_of_a_seconds_silence(
    kind: str, listen_only: bool
) -> None:
    talk = Talk(adapters.Adapter(kind), listen_only=listen_only)
    talk.run(SILENCE_S)
    for closed in ([b"C"], [b"C", b"S4", b"O"]):
        for line in closed:
            talk.far.host(line)
        before = talk.reader.counters.frames
        took_s = talk.until(lambda n=before: talk.reader.counters.frames > n, 10.0)  # type: ignore[misc]
        assert SILENCE_S <= took_s <= SILENCE_S + AGAIN_S
        talk.run(3.0)
        assert talk.far.is_silent == listen_only
    assert talk.host.silences == 2
    assert not talk.host.is_silent


def test_a_bus_that_stays_silent_is_one_silence_and_is_asked_every_second() -> None:
    talk = Talk(adapters.Adapter("lawicel"))
    talk.run(SILENCE_S)
    talk.bus_period_s = 30.0
    talk.run(2.0)
    before = talk.wrote.count(b"O")
    talk.run(10.0)
    assert talk.host.is_silent
    assert talk.host.silences == 1
    assert 8 <= talk.wrote.count(b"O") - before <= 10
    assert talk.host.refused == 0


def test_where_scans_are_seconds_apart_the_silence_between_them_closes_nothing() -> None:
    talk = Talk(adapters.Adapter("lawicel"), silence_s=5.0)
    talk.bus_period_s = 2.0
    talk.run(20.0)
    assert talk.wrote.count(b"O") == 1


@kinds
def test_no_empty_line_is_sent_which_would_repeat_an_adapters_last_command(kind: str) -> None:
    talk = Talk(adapters.Adapter(kind), listen_only=True)
    talk.run(SILENCE_S)
    talk.far.host(b"C")
    talk.run(3.0)
    assert b"" not in talk.wrote


def test_an_adapter_that_starts_for_two_seconds_after_it_was_opened_is_opened_then() -> None:
    talk = Talk(adapters.Adapter("lawicel"))
    talk.deaf_until_s = 2.0
    talk.run(4.0)
    assert talk.far.on_bus


class Picky(adapters.Adapter):
    """Refuses some commands."""

    refuses: tuple[bytes, ...] = ()

    def host(self, line: bytes, t: float = 0.0) -> tuple[bytes, Frame | None]:
        return (BEL, None) if line in self.refuses else super().host(line, t)


def test_a_refused_bit_rate_is_said_once_by_its_command_and_counted_each_time() -> None:
    far = Picky("lawicel")
    far.refuses = (b"S8",)
    talk = Talk(far)
    talk.run(10.0)
    assert talk.host.complaints == [b"S8", b"O"]
    assert talk.host.refused >= 2 * 8


def test_what_was_accepted_again_since_it_was_refused_is_said_when_it_is_refused_again() -> None:
    far = Picky("lawicel")
    talk = Talk(far)
    for refuses in ((), (b"S8",), (), (b"S8",)):
        far.refuses = refuses
        far.host(b"C")
        talk.run(4.0)
    assert talk.host.complaints == [b"S8", b"S8"]


@pytest.mark.parametrize("kind", ["lawicel", "answering canable2"])
def test_a_refused_frame_is_said_by_itself_and_is_not_taken_for_a_command(kind: str) -> None:
    talk = Talk(adapters.Adapter(kind))
    talk.run(SILENCE_S)
    request = encode(Frame(0.0, 0x5FF, b"\x3c\x00\xd2"))
    talk.frame(request)
    talk.far.host(b"C")
    for _ in range(3):
        talk.frame(request)
    talk.run(5 * TICK_S)
    assert talk.host.complaints == [b"t5FF33C00D2"]
    assert talk.host.refused == 3


def test_an_adapter_that_cannot_listen_only_is_not_opened_to_send_instead() -> None:
    far = Picky("lawicel")
    far.refuses = (b"L", b"M1")
    talk = Talk(far, listen_only=True)
    talk.run(5.0)
    assert not far.is_open
    assert b"O" not in talk.wrote
    assert talk.host.complaints[0] == b"M1"


@kinds
def test_answers_to_the_host_before_are_not_taken_for_ones_own(kind: str) -> None:
    far = adapters.Adapter(kind)
    talk = Talk(far)
    stale = [answer for line in (b"S8", b"O", b"O", b"X", b"C") if (answer := far.host(line)[0])]
    talk._on_way = [(0.02, answer) for answer in stale]
    talk.run(SILENCE_S)
    assert far.on_bus
    assert (talk.host.refused, talk.host.complaints) == (0, [])


def test_answers_that_come_late_are_waited_for_no_longer_and_do_no_harm() -> None:
    for listen_only in (False, True):
        talk = Talk(adapters.Adapter("lawicel"), listen_only=listen_only)
        talk.delay_s = 1.4 * ANSWER_S
        talk.run(SILENCE_S)
        assert (talk.far.on_bus, talk.far.is_silent) == (True, listen_only)


def test_what_was_never_answered_is_not_blamed_for_a_later_refusal() -> None:
    talk = Talk(adapters.Adapter("canable2"))
    talk.run(SILENCE_S)
    talk.frame(encode(Frame(0.0, 0x5FF, b"\x3c\x00\xd2")))
    talk.run(3.0)
    talk.host.hear([BEL])
    assert (talk.host.refused, talk.host.complaints) == (0, [])
    talk.host.hear([b"", BEL, b"z"])  # nor is anything else
    assert talk.host.refused == 0


@kinds
@both_ways
def test_an_adapter_is_left_closed_and_its_next_host_may_send(kind: str, listen_only: bool) -> None:
    talk = Talk(adapters.Adapter(kind), listen_only=listen_only)
    talk.run(SILENCE_S)
    talk._give(talk.host.closing())
    assert not talk.far.is_open
    for line in (b"S8", b"O"):
        talk.far.host(line)
    assert not talk.far.is_silent


LINES = st.lists(st.one_of(st.sampled_from([b"", b"z", b"Z", BEL]), st.binary(max_size=30)))
COMMANDS = {b"C", b"O", b"L", b"M0", b"M1", b"S8"}


@given(st.lists(st.tuples(LINES, st.booleans(), st.floats(0.0, 1.5))), st.booleans())
def test_whatever_comes_and_whenever_only_whole_commands_go_out(
    steps: list[tuple[list[bytes], bool, float]], listen_only: bool
) -> None:
    adapter, now_s = Adapter(1_000_000, listen_only=listen_only), 0.0
    for lines, sends, later_s in steps:
        adapter.hear(lines)
        if sends:
            adapter.sent(b"t1230\r", now_s)
        *commands, rest = adapter.due(now_s).split(b"\r")
        assert rest == b""
        assert set(commands) <= COMMANDS
        assert set(adapter.complaints) <= COMMANDS | {b"t1230"}
        now_s += later_s
    assert adapter.refused >= len(adapter.complaints)
