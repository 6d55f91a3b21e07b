"""iCub skin: halves paired into scans, what is missing, the commands and the virtual board."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld_protocol import icub, icub_decoder
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.frames import Frame, parse_log_line
from taxeld_protocol.icub import CHANNELS, Drop, Half
from taxeld_protocol.icub_decoder import IcubDecoder
from taxeld_protocol.modules import ABSENT_UID
from taxeld_protocol.virtual_icub import VirtualBoard

IDLE = 240


def frame(text: str) -> Frame:
    parsed = parse_log_line(text)
    assert parsed is not None
    return parsed


def feed(decoder: IcubDecoder, frames: list[Frame]) -> list[Scan]:
    return [scan for f in frames for scan in decoder.feed(f)[1]]


def knowing(frames: list[Frame]) -> IcubDecoder:
    """A decoder that has learned the triangles of a scan's frames."""
    decoder = IcubDecoder()
    feed(decoder, frames)
    feed(decoder, frames)
    decoder.flush()
    return decoder


def board_of(triangles: int, number: int = 3) -> VirtualBoard:
    board = VirtualBoard(number, range(triangles))
    board.configured = True
    return board


def values(triangles: int, start: int = 0) -> list[int]:
    """A value of its own for each channel."""
    return [start + i for i in range(CHANNELS * triangles)]


def balanced(decoder: IcubDecoder) -> bool:
    stats = decoder.stats()
    dropped = stats["dropped"]
    assert isinstance(dropped, dict)
    return stats["frames"] == stats["used"] + sum(dropped.values()) + stats["pending"]


def test_golden_frames_read_as_the_wire_says() -> None:
    head, tail = frame("4E5#40F0F1F2F3F4F5F6"), frame("4E5#C0F7F8F9FAFB0012")
    assert icub.read(head) == Half(14, 5, 0, bytes(range(0xF0, 0xF7)))
    assert icub.read(tail) == Half(14, 5, 7, bytes(range(0xF7, 0xFC)), 0x0012)
    assert icub.read(head._replace(can_id=0x3E5)) == icub.read(head)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("401#40F0F0F0F0F0F0F0", Drop.FOREIGN),  # board 0
        ("4F1#40F0F0F0F0F0F0F0", Drop.FOREIGN),  # board 15
        ("211#0700", Drop.FOREIGN),  # a command
        ("00000411#40F0F0F0F0F0F0F0", Drop.FOREIGN),
        ("411#80F0F0F0F0F0F0F0", Drop.MARK),
        ("411#40F0F0F0F0F0F0", Drop.LENGTH),
        ("411#C0F0F0F0F0", Drop.LENGTH),
        ("411#", Drop.LENGTH),
    ],
)
def test_a_frame_without_a_half_is_dropped_with_its_cause(text: str, cause: Drop) -> None:
    decoder = IcubDecoder()
    assert decoder.feed(frame(text)) == (None, [])
    assert decoder.dropped == {**dict.fromkeys(Drop, 0), cause: 1}
    assert balanced(decoder)


def test_frames_of_boards_that_are_not_the_parts_are_foreign() -> None:
    decoder = IcubDecoder([3])
    assert feed(decoder, board_of(1, number=4).scan([IDLE] * CHANNELS)) == []
    assert decoder.stats()["unknown"] == 2
    assert decoder.heard(4) == 0


def test_a_scan_ends_with_the_last_half_of_the_known_triangles() -> None:
    board = board_of(3)
    decoder = knowing(board.scan(values(3)))
    frames = [f._replace(t=5.0 + i) for i, f in enumerate(board.scan(values(3, 7)))]
    assert feed(decoder, frames[:-1]) == []
    (scan,) = feed(decoder, frames[-1:])
    assert (scan.t, scan.ihb, scan.complete) == (5.0, 3, True)
    assert scan.counts == tuple(256 - v for v in values(3, 7))


def test_counts_rise_with_pressure_and_are_never_0() -> None:
    (scan,) = feed(IcubDecoder(), board_of(1).scan([255, IDLE, 100, 0] * 3))
    assert scan.counts == (1, 16, 156, 256) * 3


def test_a_new_triangle_changes_the_table_and_keeps_the_order() -> None:
    decoder = IcubDecoder()
    (alone,) = feed(decoder, VirtualBoard(3, [5]).scan([10] * CHANNELS))
    joined = feed(decoder, VirtualBoard(3, [2, 5]).scan([20] * CHANNELS + [10] * CHANNELS))[-1]
    assert [module.sui for module in alone.table] == [37]
    assert [module.sui for module in joined.table] == [34, 37]
    assert joined.table_version > alone.table_version
    assert joined.by_module == [[236] * CHANNELS, [246] * CHANNELS]


def test_uids_follow_the_positions_file_of_the_part() -> None:
    """Slot of the triangle, triangles counted through the part's boards."""
    (scan,) = feed(IcubDecoder([9, 4]), VirtualBoard(4, [2]).scan([IDLE] * CHANNELS))
    (module,) = scan.table
    assert module.channels == len(module.names) == CHANNELS
    assert module.uids == [16 + 2 << 4 | slot for slot in range(CHANNELS)]


def test_a_channel_is_a_taxel_where_the_part_has_one_and_nothing_else_is() -> None:
    """A palm's slots 6 and 10 are taxels, and its slot 11 is a thermal pad."""
    palm = icub.ALL_CHANNELS & ~(1 << 11)
    decoder = IcubDecoder([4], {2: palm})
    (scan,) = feed(decoder, VirtualBoard(4, [2]).scan([IDLE] * CHANNELS))
    assert scan.table[0].uids == [2 << 4 | slot for slot in range(11)] + [ABSENT_UID]
    scan = feed(decoder, 2 * VirtualBoard(4, [2, 3]).scan([IDLE] * 2 * CHANNELS))[-1]
    assert scan.table[1].uids == [ABSENT_UID] * CHANNELS  # the part has no taxel on this one


def test_triangles_that_come_no_more_are_forgotten_and_then_no_scan_waits_for_them() -> None:
    board = board_of(4)
    decoder = knowing(board.scan(values(4)))
    board.triangles = [1, 2]
    scans = feed(decoder, 3 * icub_decoder.FORGET_SCANS * board.scan(values(2)))
    *waiting, last = [len(scan.table) for scan in scans]
    assert waiting[: icub_decoder.FORGET_SCANS] == [4] * icub_decoder.FORGET_SCANS
    assert last == 2
    assert feed(decoder, board.scan(values(2)))[0].complete  # with its own last half


def test_a_triangle_that_is_lost_now_and_then_is_kept() -> None:
    board = board_of(2)
    decoder = knowing(board.scan(values(2)))
    few = board.scan(values(2))[:2]
    scans = feed(decoder, 5 * ((icub_decoder.FORGET_SCANS - 1) * few + board.scan(values(2))))
    assert {len(scan.table) for scan in scans} == {2}


def test_boards_that_are_assigned_anew_have_tables_of_their_own() -> None:
    decoder = IcubDecoder([9, 4])
    frames = VirtualBoard(4, [2]).scan([IDLE] * CHANNELS)
    (before,) = feed(decoder, frames)
    decoder.assign([9, 4])
    (same,) = feed(decoder, frames)
    decoder.assign([4])
    (after,) = feed(decoder, frames)
    assert [s.table[0].sui for s in (before, same, after)] == [18, 18, 2]
    assert before.table_version == same.table_version != after.table_version


def test_answers_are_kept_and_counted_whoever_gives_them() -> None:
    decoder = IcubDecoder([9])
    texts = ["290#1C0B010402010001", "2D0#1C06030100010001"]  # a strain gauge's as well
    feed(decoder, [frame(text) for text in texts])
    assert [(a.board, a.is_skin, str(a)) for a in decoder.answered.values()] == [
        (9, True, "MTB4 1.4.2"),
        (13, False, "a board of kind 6 3.1.0"),
    ]
    assert decoder.counters.answers == decoder.frames == 2
    assert decoder.stats()["packets"] == 0
    assert balanced(decoder)


@pytest.mark.parametrize(
    "text",
    [
        "209#1C0000",  # the asking itself
        "290#1C0B0104020100",
        "290#1D0B010402010001",
        "2F0#1C0B010402010001",
        "00000290#1C0B010402010001",
    ],
)
def test_what_is_no_answer_is_none(text: str) -> None:
    assert icub.read_answer(frame(text)) is None


@pytest.mark.parametrize(
    ("error", "lost"),
    [
        (0x0000, set()),
        (0x0010, {0}),
        (0x8000, {11}),
        (0x1820, {1, 7, 8}),
        (0x0001, set()),  # some taxel did not acknowledge
        (0x0021, {1}),  # and it was this one: the others are fine
        (0x0002, set(range(CHANNELS))),
    ],
)
def test_the_error_word_takes_values_back(error: int, lost: set[int]) -> None:
    (scan,) = feed(IcubDecoder(), board_of(1).scan(values(1), {0: error}))
    assert {k for k, count in enumerate(scan.counts) if count == MISSING} == lost


def test_error_words_are_counted_by_cause() -> None:
    decoder = IcubDecoder()
    feed(decoder, board_of(4).scan(values(4), {0: 1, 1: 2, 2: 0x0FF0}))
    stats = decoder.stats()
    assert [stats[k] for k in ("no_acknowledge", "not_connected", "out_of_range")] == [1, 1, 1]


@pytest.mark.parametrize("size", [6, 7])
def test_shorter_tails_carry_no_diagnostics(size: int) -> None:
    head, tail = board_of(1).scan(values(1), {0: 0xFFFF})
    (scan,) = feed(IcubDecoder(), [head, tail._replace(data=tail.data[:size])])
    assert scan.complete


def test_a_missing_half_leaves_its_channels_missing() -> None:
    board = board_of(2)
    decoder = knowing(board.scan(values(2)))
    head, tail, *rest = board.scan(values(2, 50))
    (no_head,) = feed(decoder, [tail, *rest, head])
    assert no_head.by_module[0] == [None] * 7 + [256 - v for v in range(57, 62)]
    (no_tail,) = feed(decoder, [*rest, head])
    assert no_tail.by_module[0] == [256 - v for v in range(50, 57)] + [None] * 5


def test_a_head_whose_tail_is_lost_is_judged_by_the_tail_before() -> None:
    board = board_of(2)
    decoder = knowing(board.scan(values(2), {0: icub.NOT_CONNECTED}))
    head, _, *rest = board.scan([0] * 24, {0: icub.NOT_CONNECTED})
    (scan,) = feed(decoder, [head, *rest, head])
    assert scan.by_module[0] == [None] * CHANNELS


@given(st.lists(st.booleans(), min_size=12, max_size=12))
def test_lost_halves_mix_no_scans(kept: list[bool]) -> None:
    """Two scans of three triangles, any half of them lost."""
    board = board_of(3)
    first, second = [100] * 36, [200] * 36
    decoder = knowing(board.scan(first))
    sent = board.scan(first) + board.scan(second)
    scans = feed(decoder, [f for f, keep in zip(sent, kept, strict=True) if keep])
    scans += decoder.flush()
    found = [count for scan in scans for count in scan.counts if count != MISSING]
    sizes = [icub.HEAD_VALUES, icub.TAIL_VALUES] * 6
    assert len(found) == sum(s for s, keep in zip(sizes, kept, strict=True) if keep)
    mixed = [scan for scan in scans if {156, 56} <= set(scan.counts)]
    # nothing tells when all that was heard of the first scan stands before all of the second's
    ends = [i for i in range(6) if kept[i]], [i for i in range(6) if kept[6 + i]]
    assert not mixed or max(ends[0]) < min(ends[1])


def test_two_boards_interleaved_keep_their_scans_apart() -> None:
    one, two = board_of(2, 1).scan([10] * 24), board_of(2, 2).scan([20] * 24)
    decoder = knowing(one + two)
    scans = feed(decoder, [f for pair in zip(one, two, strict=True) for f in pair])
    assert [(scan.ihb, set(scan.counts)) for scan in scans] == [(1, {246}), (2, {236})]


def test_flush_ends_what_is_under_way() -> None:
    board = board_of(2)
    decoder = knowing(board.scan(values(2)))
    assert feed(decoder, board.scan(values(2))[:1]) == []
    (scan,) = decoder.flush()
    assert not scan.complete
    assert decoder.flush() == []


FRAMES = st.builds(
    Frame,
    st.just(0.0),
    st.integers(0, 0x7FF) | st.integers(0x410, 0x42F),
    st.binary(max_size=8)
    | st.binary(min_size=7, max_size=7).map(lambda data: b"\x40" + data)
    | st.binary(min_size=5, max_size=7).map(lambda data: b"\xc0" + data),
    st.booleans(),
)


@settings(max_examples=80)
@given(st.lists(FRAMES, max_size=60))
def test_any_frames_are_counted_once_and_a_good_scan_follows(damage: list[Frame]) -> None:
    decoder = IcubDecoder()
    scans = feed(decoder, damage)
    assert decoder.frames == len(damage)
    assert balanced(decoder)
    board = VirtualBoard(2)
    pressed = values(16)
    good = [*board.scan(pressed), *board.scan(pressed)]
    scans += feed(decoder, good)
    assert scans[-1].counts == tuple(256 - v for v in pressed)
    assert all(0 < count <= 256 or count == MISSING for scan in scans for count in scan.counts)


def test_commands_are_the_wires() -> None:
    assert icub.set_board(50) == bytes.fromhex("4D0832F0")
    assert icub.set_board(50, skin_type=2) == bytes.fromhex("4D0232F0")
    assert icub.set_triangles(0, 15) == bytes.fromhex("50000F02010022")
    assert icub.set_triangles(3, 4, enable=False)[4] == 0
    assert icub.to_frames(9, icub.ASK) == [Frame(0.0, 0x209, b"\x1c\x00\x00")]
    assert icub.to_frames(9, icub.START) == [Frame(0.0, 0x209, b"\x07\x00")]
    assert icub.to_frames(9, icub.STOP) == [Frame(0.0, 0x209, b"\x07\x01")]
    with pytest.raises(ValueError, match="210 ms"):
        icub.set_board(210)


@given(st.integers(0, 0xFFFF))
def test_runs_are_the_mask_and_none_touches_the_next(mask: int) -> None:
    runs = icub.runs(mask)
    assert mask == sum(1 << k for first, last in runs for k in range(first, last + 1))
    assert all(a[1] + 1 < b[0] for a, b in itertools.pairwise(runs))


def command(board: VirtualBoard, *commands: bytes) -> list[Frame]:
    """Its answers."""
    frames = [f for c in commands for f in icub.to_frames(board.board, c)]
    return [answer for f in frames for answer in board.take(f)]


class TestVirtualBoard:
    """What iCub's firmware does, as its sources have it."""

    def test_it_sends_at_its_period_from_start_to_stop(self) -> None:
        board = VirtualBoard(7)
        assert not board.due(0.0)
        command(board, icub.set_board(20), icub.set_triangles(0, 3), icub.START)
        assert [ms for ms in range(50) if board.due(ms / 1000)] == [0, 20, 40]
        command(board, icub.STOP)
        assert not board.due(1.0)

    def test_all_its_triangles_are_enabled_after_power_up(self) -> None:
        board = VirtualBoard(7)
        command(board, icub.START)
        assert len(board.scan([IDLE] * 16 * CHANNELS)) == 32

    @pytest.mark.parametrize("sending", [False, True])
    def test_setting_the_board_disables_every_triangle(self, sending: bool) -> None:
        board = VirtualBoard(7)
        if sending:
            command(board, icub.START)
        command(board, icub.set_board(20, skin_type=3))
        assert (board.running, board.skin_type, board.triangles) == (sending, 3, [])
        command(board, icub.START)
        assert board.scan([]) == []

    def test_setting_triangles_enables_calibrates_and_stops(self) -> None:
        board = VirtualBoard(7)
        command(board, icub.set_board(20), icub.START, icub.set_triangles(2, 3))
        assert (board.running, board.calibrations, board.triangles) == (False, 1, [2, 3])
        command(board, icub.START)
        assert {f.can_id for f in board.scan(values(2))} == {0x472, 0x473}
        command(board, icub.set_triangles(3, 3, enable=False))
        assert board.triangles == [2]

    @pytest.mark.parametrize(("first", "last"), [(3, 2), (0, 16), (16, 16)])
    def test_triangles_that_it_has_not_are_passed_over(self, first: int, last: int) -> None:
        board = VirtualBoard(7, [5])
        command(board, icub.START, icub.set_triangles(first, last))
        assert (board.running, board.calibrations, board.triangles) == (True, 0, [5])

    @pytest.mark.parametrize("setting", [icub.set_board(20), icub.set_triangles(0), icub.START])
    def test_it_sends_under_the_old_ids_until_it_is_told_anything(self, setting: bytes) -> None:
        board = VirtualBoard(7, [1])
        assert {f.can_id for f in board.scan(values(1))} == {0x371}
        command(board, setting)
        board.triangles = [1]
        assert {f.can_id for f in board.scan(values(1))} == {0x471}

    def test_it_says_what_it_is_and_goes_on_sending(self) -> None:
        board = VirtualBoard(7)
        command(board, icub.START)
        (answer,) = command(board, icub.ASK)
        assert answer.can_id == 0x270
        assert icub.read_answer(answer) == icub.Answer(7, 11, (1, 4, 2))
        assert board.running

    def test_it_obeys_no_one_elses_commands(self) -> None:
        board = VirtualBoard(7)
        for other in (
            *icub.to_frames(6, icub.START),
            Frame(0.0, 0x207, icub.START, True),
            Frame(0.0, 0x207, b""),
            Frame(0.0, 0x207, b"\x99\x00"),
        ):
            assert board.take(other) == []
        assert not board.running
        with pytest.raises(ValueError, match="3 values for 192 channels"):
            board.scan([1, 2, 3])
