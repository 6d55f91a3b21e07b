"""Packets and their fragments on CAN."""

import re
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from taxeld_protocol import commands, serial_link, slcan
from taxeld_protocol.cyskin import (
    FRAGMENT_BYTES,
    LEAVE_BOOTLOADER,
    MAX_FRAGMENTS,
    Packet,
    Reassembler,
    encode,
    fragment,
    to_frames,
)
from taxeld_protocol.frames import Frame, format_log_line, parse_log_line
from taxeld_protocol.serial_link import SerialReader
from taxeld_protocol.slcan import SlcanReader

# candump lines of a scan, computed by hand from the rules of the wire
GOLDEN_SCAN = [
    "101#431A000027102711",
    "201#2712271327142715",
    "201#2716271727182719",
    "401#271A271BA9",
]

packets = st.tuples(
    st.integers(0, 255), st.binary(max_size=255), st.integers(0, 255)
)  # command, payload, hub


def golden(text: str) -> Frame:
    return parse_log_line(text)  # type: ignore[return-value]


def test_the_frame_that_ends_the_bootloader_is_the_published_one() -> None:
    """As the vendor's library sends it; its last bytes are a CRC-16/X-25 of Cypress's protocol."""
    [frame] = to_frames(LEAVE_BOOTLOADER, ihb=0xFF, t=2.0)
    assert frame == Frame(2.0, 0x17FFFFFF, bytes.fromhex("013B00004F6D17"), extended=True)
    assert format_log_line(frame).endswith(" 17FFFFFF#013B00004F6D17")
    crc = 0xFFFF
    for byte in frame.data[:4]:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0x8408 if crc & 1 else crc >> 1
    assert (crc ^ 0xFFFF).to_bytes(2, "big") == frame.data[4:6]
    assert Reassembler().feed(frame) is None


@given(st.binary(max_size=255), st.integers(0, 40))
def test_only_what_fits_the_last_fragment_may_follow_a_packet(payload: bytes, more: int) -> None:
    """Where fragments of two packets are taken for one, the first's checksum may still be right."""
    link = Reassembler()
    frames = fragment(encode(0x43, payload) + bytes(more), 1)
    assert ([link.feed(frame) for frame in frames][-1] is None) == (more >= FRAGMENT_BYTES)
    assert link.counters.length_errors == (more >= FRAGMENT_BYTES)


@given(st.lists(packets, max_size=6), st.randoms())
def test_hubs_may_interleave(sent: list[tuple[int, bytes, int]], random) -> None:  # type: ignore[no-untyped-def]
    queues = [to_frames(c, p, ihb=ihb) for ihb, (c, p, _) in enumerate(sent, 1)]
    link, got = Reassembler(), []
    while any(queues):
        packet = link.feed(random.choice([q for q in queues if q]).pop(0))
        if packet:
            got.append((packet.ihb, packet.command, packet.payload))
    assert sorted(got) == [(ihb, c, p) for ihb, (c, p, _) in enumerate(sent, 1)]


frames = st.builds(
    Frame,
    st.just(0.0),
    st.one_of(
        st.integers(0, 0x7FF), st.sampled_from([0x101, 0x201, 0x401, 0x501, 0x1FF, 0x2FF, 0x4FF])
    ),
    st.binary(max_size=8),
    st.booleans(),
)


@given(st.lists(frames, max_size=60))
def test_every_frame_is_counted_exactly_once(noise: list[Frame]) -> None:
    link = Reassembler()
    for frame in noise:
        link.feed(frame)
    c = link.counters
    assert c.frames == len(noise)
    assert c.frames == c.used + c.foreign + c.orphan + c.length + c.crc + link.pending


@given(st.lists(frames, max_size=30), packets)
def test_damage_costs_only_the_damaged(noise: list[Frame], packet: tuple[int, bytes, int]) -> None:
    link = Reassembler()
    for frame in noise:
        link.feed(frame)
    command, payload, ihb = packet
    before = link.pending
    *early, last = [link.feed(frame) for frame in to_frames(command, payload, ihb=ihb, t=2.5)]
    assert not any(early)
    assert last == Packet(2.5, ihb, command, payload)
    assert link.pending <= before, "of the packet nothing is left"


def test_a_packet_without_end_is_bounded() -> None:
    link = Reassembler()
    link.feed(Frame(0.0, 0x101, bytes(8)))
    for _ in range(1000):
        link.feed(Frame(0.0, 0x201, bytes(8)))
        assert link.pending <= MAX_FRAGMENTS


@given(st.floats(0, 4e9), st.integers(0, 0x7FF), st.binary(max_size=8))
def test_log_lines_round_trip(t: float, can_id: int, data: bytes) -> None:
    frame = Frame(round(t, 6), can_id, data)
    assert parse_log_line(format_log_line(frame)) == frame
    long = Frame(round(t, 6), can_id << 18, data, True)
    assert parse_log_line(format_log_line(long)) == long


@pytest.mark.parametrize(
    "text",
    ["", "junk", "101#4", "101#ZZ", "(1.0) can0 101", "101#112233445566778899", "1011#00", "101#R"],
)
def test_what_is_no_log_line_is_none(text: str) -> None:
    assert parse_log_line(text) is None


SIDES = [
    (commands.REQUESTS, commands.request, commands.parse_request),
    (commands.ANSWERS, commands.answer, commands.parse_answer),
]


@pytest.mark.parametrize(("table", "encode", "decode"), SIDES, ids=["requests", "answers"])
def test_the_fields_of_every_command_round_trip_and_another_length_is_none(
    table: commands.Table, encode: Any, decode: Any
) -> None:
    for command, (_, names) in table.items():
        fields = {name: i + 1 for i, name in enumerate(names)}
        payload = encode(command, **fields)
        assert decode(command, payload) == fields
        assert decode(command, payload + b"\0") is decode(command, payload[:-1]) is None


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    """`data` cut at places that `cuts` choose."""
    at = sorted({cut % (len(data) + 1) for cut in cuts} | {0, len(data)})
    return [data[a:b] for a, b in pairwise(at)]


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


@given(st.lists(st.binary(max_size=40), max_size=10))
def test_slcan_frames_survive_the_noise_before_them(noise: list[bytes]) -> None:
    reader = SlcanReader()
    for part in noise:
        reader.feed(part, 0.0)
    frame = Frame(0.0, 0x101, b"12345678")
    assert reader.feed(b"\r" + slcan.encode(frame), 0.0)[-1] == frame


READERS = {
    SerialReader: lambda k: serial_link.encode(0x3B + k % 2, ihb=k),
    SlcanReader: lambda k: slcan.encode(Frame(0.0, 0x100 + k, b"\x01\x02")),
}


@pytest.mark.parametrize("kind", READERS)
@example([b"x" * (slcan.MAX_LINE + 1)], [])
@example([b"x" * 300], [300])  # the end of a line that is too long comes as a piece
@example([b"T17FFFFFF8" + b"A5" * 8 + b"000000000\r"], [])  # one digit more than the longest
@given(st.lists(st.binary(max_size=400), max_size=6), st.lists(st.integers(0, 10**6)))
def test_the_pieces_a_line_comes_in_do_not_matter(
    kind: Any, noise: list[bytes], cuts: list[int]
) -> None:
    """What is read and counted is the same; the end of a line that is too long is no frame,
    wherever it is cut."""
    line = b"".join(part + READERS[kind](k) for k, part in enumerate(noise))
    found = []
    for cut in ([line], pieces(line, cuts), [bytes((byte,)) for byte in line]):
        reader = kind()
        got = [one for piece in cut for one in reader.feed(piece, 0.0)]
        found.append((got, getattr(reader, "foreign", 0), getattr(reader, "counters", 0)))
    assert found[0] == found[1] == found[2]


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


LINE = re.compile(
    rb"(?:t(?P<short>[0-7][0-9A-Fa-f]{2})|T(?P<long>[01][0-9A-Fa-f]{7}))"
    rb"(?P<length>[0-8])(?P<rest>(?:[0-9A-Fa-f]{2})*)"
)
LINES = [b"t1_00", b"t+1F0", b"T0x00000f0", b"tFFF0", b"TFFFFFFFF0", b"t1019", b"t1011 1"]
STAMPED = [
    line + b"0" * digits
    for line in (b"t1012AABB", b"T17FFFFFF0", b"t1018" + b"A5" * 8)
    for digits in (*range(13), 16)
]


def examples(test: Any) -> Any:
    for line in (*LINES, *STAMPED):
        test = example(line)(test)
    return test


@examples
@given(
    st.one_of(
        st.from_regex(rb"(t[0-9A-Fa-f]{3}|T[0-3][0-9A-Fa-f]{7})[0-9][0-9A-Fa-f]{0,20}\Z"),
        st.text("t0178Aa +_x\a-", max_size=24).map(lambda text: b"t" + text.encode()),
    )
)
def test_a_line_is_a_frame_only_if_it_is_one_to_the_letter(line: bytes) -> None:
    """Digits that are no stamp are damage, as is what only looks like a number."""
    frame, match = slcan.parse(line, 1.5), LINE.fullmatch(line.removesuffix(b"\a"))
    rest = match and len(match["rest"]) // 2 - int(match["length"])
    assert (frame is not None) == (rest in slcan.STAMP_BYTES)
    if frame is not None and match is not None:
        data = bytes.fromhex(match["rest"].decode())[: int(match["length"])]
        number = int(match["short"] or match["long"], 16)
        assert frame == Frame(1.5, number, data, extended=match["long"] is not None)
