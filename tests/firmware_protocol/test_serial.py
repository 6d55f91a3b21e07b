"""The native serial link and SLCAN: bytes in pieces of any size."""

import re
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from taxeld_protocol import serial_link, slcan
from taxeld_protocol.cyskin import Packet
from taxeld_protocol.frames import Frame
from taxeld_protocol.serial_link import SerialReader
from taxeld_protocol.slcan import SlcanReader

packets = st.tuples(st.integers(0, 255), st.binary(max_size=255), st.integers(0, 255))


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    """`data` cut at places that `cuts` choose."""
    at = sorted({cut % (len(data) + 1) for cut in cuts} | {0, len(data)})
    return [data[a:b] for a, b in pairwise(at)]


@given(st.lists(packets, max_size=5), st.lists(st.integers(0, 10**6), max_size=20))
def test_packets_come_through_pieces_of_any_size(
    sent: list[tuple[int, bytes, int]], cuts: list[int]
) -> None:
    line = b"".join(serial_link.encode(c, p, ihb=i) for c, p, i in sent)
    reader, got = SerialReader(), []
    for piece in pieces(line, cuts):
        got += reader.feed(piece, 1.5)
    assert got == [Packet(1.5, i, c, p) for c, p, i in sent]
    assert reader.counters.used == reader.counters.bytes == len(line)


@given(st.lists(st.one_of(packets, st.binary(max_size=400)), max_size=8))
def test_noise_costs_only_what_it_touches(parts: list[tuple[int, bytes, int] | bytes]) -> None:
    reader, got, wanted = SerialReader(), [], []
    for part in parts:
        if isinstance(part, bytes):
            got += reader.feed(part + b"\0", 0.0)  # noise that ends in a delimiter
        else:
            command, payload, ihb = part
            wanted.append(Packet(0.0, ihb, command, payload))
            got += reader.feed(serial_link.encode(command, payload, ihb=ihb), 0.0)
    clean = sum(len(serial_link.encode(p.command, p.payload, ihb=p.ihb)) for p in wanted)
    assert [p for p in got if p in wanted] == wanted
    assert clean <= reader.counters.used <= reader.counters.bytes - reader.pending


def test_a_line_without_delimiters_is_bounded() -> None:
    reader = SerialReader()
    for _ in range(100):
        reader.feed(b"\x55" * 1000, 0.0)
        assert reader.pending <= serial_link.MAX_ENCODED


@example([b"x" * (slcan.MAX_LINE + 1)], [])
@given(st.lists(st.binary(max_size=80), max_size=6), st.lists(st.integers(0, 10**6)))
def test_the_pieces_an_slcan_line_comes_in_do_not_matter(
    noise: list[bytes], cuts: list[int]
) -> None:
    """The end of a line that is too long is no frame, wherever it is cut."""
    line = b"".join(part + slcan.encode(Frame(0.0, 0x101, b"\x01\x02")) for part in noise)
    whole, cut = SlcanReader(), SlcanReader()
    wanted = whole.feed(line, 0.0)
    assert [f for piece in pieces(line, cuts) for f in cut.feed(piece, 0.0)] == wanted
    bytewise = SlcanReader()
    assert [f for byte in line for f in bytewise.feed(bytes((byte,)), 0.0)] == wanted
    assert bytewise.foreign == cut.foreign == whole.foreign


@given(st.lists(st.binary(max_size=40), max_size=10))
def test_slcan_frames_survive_the_noise_before_them(noise: list[bytes]) -> None:
    reader = SlcanReader()
    for part in noise:
        reader.feed(part, 0.0)
    frame = Frame(0.0, 0x101, b"12345678")
    assert reader.feed(b"\r" + slcan.encode(frame), 0.0)[-1] == frame


@pytest.mark.parametrize(
    "line", [b"t1_00", b"t+1F0", b"T0x00000f0", b"tFFF0", b"TFFFFFFFF0", b"t1019", b"t1011 1"]
)
def test_what_only_looks_like_a_number_is_no_frame(line: bytes) -> None:
    assert slcan.parse(line) is None


@given(st.lists(st.binary(min_size=200, max_size=400), max_size=6), st.lists(st.integers(0, 10**6)))
def test_the_pieces_a_line_comes_in_do_not_matter(noise: list[bytes], cuts: list[int]) -> None:
    """Packets and counters are the same however a line is cut, over-long frames included."""
    line = b"".join(noise) + serial_link.encode(0x3B, ihb=1) + serial_link.encode(0x3C, ihb=2)
    whole, cut = SerialReader(), SerialReader()
    wanted = whole.feed(line, 0.0)
    assert [p for piece in pieces(line, cuts) for p in cut.feed(piece, 0.0)] == wanted
    bytewise = SerialReader()
    assert [p for byte in line for p in bytewise.feed(bytes((byte,)), 0.0)] == wanted
    assert bytewise.counters == whole.counters
    assert cut.counters == whole.counters


FRAMES = st.builds(
    lambda short, long, extended, data: Frame(1.5, long if extended else short, data, extended),
    st.integers(0, 0x7FF),
    st.integers(0, 0x1FFFFFFF),
    st.booleans(),
    st.binary(max_size=8),
)
STAMPS = st.one_of(
    st.just(b""),
    st.integers(0, 0xFFFF).map(lambda ms: b"%04X" % ms),
    st.integers(0, 0xFFFFFFFF).map(lambda us: b"%08X" % us),
)


@given(st.lists(st.tuples(FRAMES, STAMPS), max_size=8), st.lists(st.integers(0, 10**6)))
def test_stamps_of_none_four_or_eight_digits_also_mixed_leave_the_data_as_it_is(
    sent: list[tuple[Frame, bytes]], cuts: list[int]
) -> None:
    line = b"".join(slcan.encode(frame)[:-1] + stamp + b"\r" for frame, stamp in sent)
    reader, got = SlcanReader(), []
    for piece in pieces(line, cuts):
        got += reader.feed(piece, 1.5)
    assert got == [frame for frame, _ in sent]


@pytest.mark.parametrize("digits", [1, 2, 3, 5, 6, 7, 9, 10, 12, 16])
def test_digits_that_are_no_stamp_are_damage(digits: int) -> None:
    for line in (b"t1012AABB", b"T17FFFFFF0", b"t1018" + b"A5" * 8):
        assert slcan.parse(line) is not None
        assert slcan.parse(line + b"0" * digits) is None


REMOTE = [b"r1010", b"r7FF8", b"r10181A2B", b"r10180001A2B3", b"R17FFFFFF0", b"R000000008FFFF"]
NOISE = [b"r101", b"r1019", b"r8000", b"R2000000008", b"r101812", b"s12"]


@pytest.mark.parametrize(
    ("line", "foreign"), [(line, True) for line in REMOTE] + [(line, False) for line in NOISE]
)
def test_a_remote_frame_is_foreign_and_its_likeness_is_noise(line: bytes, foreign: bool) -> None:
    reader = SlcanReader()
    assert reader.feed(line + b"\r", 0.0) == []
    assert reader.foreign == foreign


def test_answers_are_no_frames_and_a_refusal_ends_a_line_as_well() -> None:
    reader = SlcanReader()
    frame = Frame(0.0, 0x101, b"\xaa")
    assert reader.feed(b"\r\az\rZ\r" + slcan.encode(frame)[:-1] + b"\a", 0.0) == [frame]
    assert reader.foreign == 0
    assert slcan.split(b"\r\at1010\a")[0] == [b"", b"\a", b"t1010\a"]


LINE = re.compile(rb"t([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")


@given(
    st.one_of(
        st.from_regex(rb"t[0-9A-Fa-f]{3}[0-9][0-9A-Fa-f]{0,20}", fullmatch=True),
        st.text("t0178Aa +_x\a-", max_size=24).map(lambda text: b"t" + text.encode()),
    )
)
def test_a_line_of_a_short_id_is_a_frame_only_if_it_is_one_to_the_letter(line: bytes) -> None:
    frame, match = slcan.parse(line, 1.5), LINE.fullmatch(line.removesuffix(b"\a"))
    is_frame = match is not None and len(match[3]) // 2 - int(match[2]) in slcan.STAMP_BYTES
    assert (frame is not None) == is_frame
    if frame is not None and match is not None:
        data = bytes.fromhex(match[3].decode())[: int(match[2])]
        assert frame == Frame(1.5, int(match[1], 16), data)
