"""Bring-up of iCub boards: found by asking, set up in an order that their firmware bears."""

import itertools
from collections.abc import Sequence

import pytest

from taxeld.config.tables import SourceConfig
from taxeld.source import icub_part
from taxeld.source.icub_bring_up import IcubBringUp
from taxeld_protocol import icub
from taxeld_protocol.frames import Frame
from taxeld_protocol.icub_decoder import IcubDecoder
from tests.rig.virtual_part import BOARDS, TICK_S, TRIANGLES, Boards, skin_layout

PART = icub_part.of(skin_layout())
EVERY = {(9, 0), (9, 1), (4, 3)}  # (board, triangle) that the layout has taxels on


class BoardBench:
    """A bring-up and the boards it speaks to, on one clock."""

    def __init__(
        self, boards: Boards, named: Sequence[int] = (), period_ms: int = 50, **more: int
    ) -> None:
        self.bus = boards
        self.decoder = IcubDecoder(named, PART.taxels)
        config = SourceConfig("can", period_ms=period_ms, **more)  # type: ignore[arg-type]
        self.bring_up = IcubBringUp(self.decoder, PART, named, config)
        self.heard: set[tuple[int, int]] = set()

    def run(self, seconds: float) -> "BoardBench":
        for _ in range(round(seconds / TICK_S)):
            self.bus.now_s += TICK_S
            frames = self.bus.scans()
            for request in self.bring_up.due(self.bus.now_s):
                frames += self.bus.tell(icub.to_frames(*request))
            for frame in frames:
                self.feed(frame)
        return self

    def feed(self, frame: Frame) -> None:
        self.decoder.feed(frame)
        half = icub.read(frame)
        if isinstance(half, icub.Half):
            self.heard.add((half.board, half.triangle))

    def told(self, board: int) -> list[bytes]:
        """What a board was told, beside what it was asked."""
        return [c for _, b, c in self.bus.sent if b == board and c != icub.ASK]


@pytest.mark.parametrize("named", [BOARDS, (4, 9)])
def test_named_boards_send_the_triangles_that_the_layout_has_and_no_other(named) -> None:
    bench = BoardBench(Boards(*BOARDS, 5), named).run(3.0)
    of = dict(zip(named, PART.triangles, strict=True))
    wanted = {(board, k) for board, mask in of.items() for k in range(16) if mask >> k & 1}
    assert bench.heard == wanted
    assert [bench.bus.boards[b].calibrations for b in (*BOARDS, 5)] == [1, 1, 0]
    assert bench.told(5) == []


def test_a_board_is_configured_then_its_triangles_then_started() -> None:
    bench = BoardBench(Boards(*BOARDS), BOARDS).run(3.0)
    assert bench.told(9) == [
        bytes.fromhex("4D0832F0"),
        bytes.fromhex("50000102010022"),
        bytes.fromhex("0700"),
    ]
    assert bench.told(4)[1] == bytes.fromhex("50030302010022")
    assert [bench.bus.boards[b].triangles for b in BOARDS] == [TRIANGLES[b] for b in BOARDS]


def test_boards_get_the_configured_shift_offset_and_idle_value() -> None:
    """As an ergoCub's hand has them."""
    hand = {"skin_type": 3, "shift_bits": 0, "offset_counts": 0x2000, "no_load_counts": 0xC8}
    bench = BoardBench(Boards(*BOARDS), BOARDS, **hand).run(3.0)
    assert bench.told(9) == [
        bytes.fromhex("4D0332C8"),
        bytes.fromhex("50000100010020"),
        bytes.fromhex("0700"),
    ]


@pytest.mark.parametrize("mask", [0b1000_0000_0110_0001, 0b0101_0101_0101_0101])
def test_triangles_apart_are_enabled_run_by_run_and_no_board_is_said_to_be_silent_meanwhile(
    mask: int,
) -> None:
    bench = BoardBench(Boards(9), (9,))
    part = icub_part.Part("part", (mask,), PART.taxels)
    bench.bring_up = IcubBringUp(bench.decoder, part, (9,), SourceConfig("can"))
    for _ in range(60):
        assert bench.run(0.1).bring_up.waits_for == ""
    assert {triangle for _, triangle in bench.heard} == {k for k in range(16) if mask >> k & 1}


@pytest.mark.parametrize("period_ms", [50, 209])
def test_no_command_reaches_a_board_that_is_busy_with_the_last(period_ms: int) -> None:
    """A board that calibrates waits for two of its periods, and takes what waits last first."""
    bench = BoardBench(Boards(*BOARDS), BOARDS, period_ms).run(5.0)
    for board in BOARDS:
        sent = [(t, c) for t, b, c in bench.bus.sent if b == board and c != icub.ASK]
        for (before_s, command), (after_s, _) in itertools.pairwise(sent):
            calibrates = command[0] == icub.SET_TRIANGLES
            least_s = 0.4 + 2 * period_ms / 1000 if calibrates else 0.05
            assert after_s - before_s >= least_s - 1e-9


def test_boards_are_found_by_asking_and_taken_in_ascending_order() -> None:
    bench = BoardBench(Boards(9, 4)).run(4.0)
    # the layout's first board is the one with the lower address
    assert bench.heard == {(4, 0), (4, 1), (9, 3)}
    assert bench.bring_up.waits_for == ""
    assert {b for _, b, c in bench.bus.sent if c == icub.ASK} == set(icub.BOARDS)
    assert {b for _, b, c in bench.bus.sent if c != icub.ASK} == {4, 9}


def test_boards_of_other_kinds_answer_and_are_not_the_skins() -> None:
    bench = BoardBench(Boards(9, 4))
    bench.feed(Frame(0.0, 0x2D0, bytes.fromhex("1C06030100010001")))  # a strain gauge
    bench.run(4.0)
    assert len(bench.heard) == len(EVERY)


def test_where_more_boards_answer_than_the_part_has_none_is_touched() -> None:
    bench = BoardBench(Boards(9, 4, 12)).run(10.0)
    assert {c for _, _, c in bench.bus.sent} == {icub.ASK}
    line = bench.bring_up.waits_for
    assert line.startswith("source.boards: boards 4, 9, 12 answer, but cylinder")
    assert line.endswith(
        "has the triangles of 2; name the part's, in the order of its positions file"
    )


def test_boards_that_come_up_one_by_one_are_not_taken_for_the_part() -> None:
    """All boards of a bus get their power at once, but not all answer at once."""
    boards = Boards()
    bench = BoardBench(boards)
    for number in (4, 9, 12):
        bench.run(0.6)
        boards.replace(number)
    bench.run(5.0)
    assert {c for _, _, c in boards.sent} == {icub.ASK}
    assert "boards 4, 9, 12 answer" in bench.bring_up.waits_for


def test_a_board_that_comes_late_is_found() -> None:
    boards = Boards(9)
    bench = BoardBench(boards).run(60.0)
    assert bench.bring_up.waits_for.startswith("source.boards: board 9 answers, but ")
    boards.replace(4)
    bench.run(3.0)
    assert len(bench.heard) == len(EVERY)
    assert bench.bring_up.waits_for == ""


def test_a_bus_without_any_board_is_asked_slowly_and_said_to_be_empty() -> None:
    boards = Boards()
    bench = BoardBench(boards).run(2.0)
    assert bench.bring_up.waits_for == ""  # boards take seconds to come up
    bench.run(8.0)
    assert bench.bring_up.waits_for.startswith("source.boards: boards 1..14: no skin board answers")
    assert "Ethernet board (EMS)" in bench.bring_up.waits_for
    assert len(boards.sent) == 14 * 20


def test_a_named_board_that_answers_nothing_is_said_and_the_others_send() -> None:
    boards = Boards(9)
    bench = BoardBench(boards, BOARDS).run(10.0)
    assert bench.bring_up.waits_for.startswith("source.boards: board 4: no answer; see that")
    assert bench.heard == {(9, 0), (9, 1)}
    assert boards.boards[9].calibrations == 1
    asked = [t for t, b, c in boards.sent if b == 4]
    assert len(asked) <= 4 * 10 / 1.5
    boards.replace(4)
    bench.run(5.0)
    assert boards.boards[4].triangles == TRIANGLES[4]
    assert (4, 3) in bench.heard
    assert bench.bring_up.waits_for == ""


def test_a_board_that_answers_and_sends_nothing_is_said_with_its_firmware() -> None:
    boards = Boards(*BOARDS)
    boards.boards[4].due = lambda _: False  # type: ignore[method-assign]
    bench = BoardBench(boards, BOARDS).run(10.0)
    line = bench.bring_up.waits_for
    assert line == "source.boards: nothing comes from board 4 (answers, as MTB4 1.4.2)"


def test_a_named_board_too_old_to_be_asked_is_brought_up_once() -> None:
    boards = Boards(*BOARDS)
    take = boards.boards[4].take
    boards.boards[4].take = lambda f: [] if f.data == icub.ASK else take(f)  # type: ignore[method-assign]
    assert BoardBench(boards, BOARDS).run(10.0).heard == EVERY
    assert boards.boards[4].calibrations == 1


@pytest.mark.parametrize("up_ms", range(0, 1900, 190))
def test_a_board_that_comes_up_amidst_its_bring_up_is_set_up_in_the_end(up_ms: int) -> None:
    """It may get its start alone, and would send all it has, at its own period."""
    boards = Boards(9)
    bench = BoardBench(boards, BOARDS, period_ms=20).run(4.0 + up_ms / 1000)
    boards.replace(4)
    bench.run(5.0)
    late = boards.boards[4]
    assert (late.triangles, late.period_ms, late.skin_type) == (TRIANGLES[4], 20, icub.SKIN_TYPE)
    assert late.running
    assert boards.boards[9].calibrations == 1


def test_a_board_that_lost_its_power_is_brought_up_again_and_the_others_are_left_alone() -> None:
    boards = Boards(*BOARDS)
    bench = BoardBench(boards, BOARDS).run(5.0)
    boards.replace(4)
    bench.heard.clear()
    bench.run(4.0)
    assert bench.heard == EVERY
    assert [boards.boards[b].calibrations for b in BOARDS] == [1, 1]
    assert len(bench.told(9)) == 3


def test_boards_that_send_are_left_alone_when_the_adapter_was_opened_anew() -> None:
    """A board that is configured calibrates itself, which would hide a touch."""
    boards = Boards(*BOARDS)
    bench = BoardBench(boards, BOARDS, period_ms=209).run(5.0)
    bench.bring_up.restart()
    bench.run(3.0)
    assert [boards.boards[b].calibrations for b in BOARDS] == [1, 1]
    boards.replace(4)
    bench.bring_up.restart()
    bench.run(3.0)
    assert [boards.boards[b].calibrations for b in BOARDS] == [1, 1]
    assert len(bench.told(4)) == 6


def test_only_what_was_brought_up_is_stopped() -> None:
    bench = BoardBench(Boards(9, 4, 12))
    assert bench.bring_up.stop() == []
    bench = BoardBench(Boards(9, 4, 12), BOARDS).run(3.0)
    assert sorted(bench.bring_up.stop()) == [(4, icub.STOP), (9, icub.STOP)]
