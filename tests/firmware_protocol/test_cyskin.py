"""Packets and their fragments on CAN."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld_protocol import commands
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
    frame = parse_log_line(text)
    assert frame is not None
    return frame


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
    packet = [link.feed(frame) for frame in frames][-1]
    assert (packet is None) == (more >= FRAGMENT_BYTES)
    assert link.counters.length_errors == (more >= FRAGMENT_BYTES)


@given(st.lists(packets, max_size=6), st.randoms())
def test_hubs_may_interleave(sent: list[tuple[int, bytes, int]], random) -> None:  # type: ignore[no-untyped-def]
    queues = [to_frames(c, p, ihb=ihb) for ihb, (c, p, _) in enumerate(sent, 1)]
    link, got = Reassembler(), []
    while any(queues):
        queue = random.choice([q for q in queues if q])
        packet = link.feed(queue.pop(0))
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
