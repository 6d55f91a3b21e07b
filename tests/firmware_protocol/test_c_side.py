"""The C side against the vectors and the Python side, and under the sanitizers."""

import ctypes
import os
import re
import struct
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from enum import IntEnum
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld_protocol import commands, cyskin, serial_link
from taxeld_protocol.cyskin import Command, Packet, Reassembler
from taxeld_protocol.decoder import MISSING, Decoder
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import Module
from taxeld_protocol.serial_link import SerialReader

from ..rig.examples import examples
from .c_side import (
    E_ARGUMENT,
    E_COBS,
    E_CRC,
    E_LENGTH,
    E_ROOM,
    MIRRORS,
    PACKET_MAX,
    SANITIZED,
    C,
    CSide,
    compile_c,
    size_t,
)
from .test_vectors import VECTORS

ROUNDS_OF_DAMAGE = 20_000
SECONDS = 120  # that the sanitized program may take

HEADER = (C / "taxeld_protocol.h").read_text(encoding="utf-8")

WITHOUT_FIELDS = Command.DISCOVERY_PING, Command.DECLARE, Command.MODULE_PROGRAM_END

Case = dict[str, Any]
Received = tuple[list[Packet], dict[str, int], int]  # delivered, counters, pending


@pytest.fixture(scope="session")
def c_side(tmp_path_factory: pytest.TempPathFactory) -> CSide:
    library = tmp_path_factory.mktemp("c") / "libtaxeld_protocol.so"
    compile_c("-O2", "-Wconversion", "-shared", "-fPIC", C / "test_driver.c", "-o", library)
    return CSide(library)


def python_reassemble(frames: Iterable[Frame]) -> Received:
    reassembler = Reassembler()
    packets = [packet for frame in frames if (packet := reassembler.feed(frame))]
    return packets, asdict(reassembler.counters), reassembler.pending


def python_receive(line: bytes) -> Received:
    reader = SerialReader()
    return reader.feed(line, 0.0), asdict(reader.counters), reader.pending


def cut(line: bytes, sizes: Sequence[int]) -> Iterator[bytes]:
    """The line in pieces of these sizes, over and over."""
    at = i = 0
    while at < len(line):
        yield line[at : at + sizes[i % len(sizes)]]
        at += sizes[i % len(sizes)]
        i += 1


def test_mirrored_structs_have_their_size_in_c(c_side: CSide) -> None:
    sizes = (size_t * len(MIRRORS)).in_dll(c_side.c, "driver_sizes")
    assert [ctypes.sizeof(mirror) for mirror in MIRRORS] == list(sizes)


def test_the_usage_examples_of_the_header_compile(tmp_path: Path) -> None:
    comment = HEADER.split("*/")[0]
    code = "\n".join(
        line[7:] if line.startswith(" *     ") or line == " *" else "//"  # text ends a snippet
        for line in comment.splitlines()
    )
    on_can, sending, receiving = (part for part in f"{code}\n".split("//\n") if part.strip())
    source = f"""
        #include "taxeld_protocol.h"
        #define SHORT_ID 1
        void can_send(uint32_t id, const uint8_t *data, size_t n);
        void uart_write(const uint8_t *data, size_t n);
        void answer(const taxeld_packet *packet);
        void scan_to_can(const uint16_t *counts, size_t n);
        void send_line(const uint8_t *packet, int len);
        void receive(const uint8_t *data, size_t n);
        {on_can}
        void send_line(const uint8_t *packet, int len) {{ {sending} }}
        void receive(const uint8_t *data, size_t n)
        {{ static taxeld_receiver receiver; taxeld_packet packet; {receiving} }}
    """
    (tmp_path / "example.c").write_text(source, encoding="utf-8")
    compile_c("-c", f"-I{C}", tmp_path / "example.c", "-o", tmp_path / "example.o")


@pytest.mark.parametrize(
    ("enum", "prefix", "values"),
    [("command", "TAXELD_", Command), ("error", "TAXELD_ERROR_", cyskin.ErrorCode)],
)
def test_both_sides_have_the_same_codes(enum: str, prefix: str, values: type[IntEnum]) -> None:
    [body] = re.findall(rf"typedef enum {{([^}}]*)}} taxeld_{enum};", HEADER)
    codes = dict(re.findall(rf"\b{prefix}(\w+) = (0x\w+)", body))
    assert {name: int(code, 16) for name, code in codes.items()} == {v.name: v for v in values}


MODULE = {"sui": 1, "mask": 0x7FF, "channels": 11}
PACKET = cyskin.encode(Command.VERSION, b"v1")


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda c: c.encode(Command.VERSION, bytes(256)), E_ARGUMENT),
        (lambda c: c.fragment(b"", 1), E_LENGTH),
        (lambda c: c.fragment(bytes(PACKET_MAX + 1), 1), E_LENGTH),
        (lambda c: c.declare([13]), E_ARGUMENT),
        (lambda c: c.declare([1] * 249), E_ARGUMENT),
        (lambda c: c.details(248, MODULE), E_ARGUMENT),
        (lambda c: c.details(0, MODULE | {"channels": 13}), E_ARGUMENT),
        (lambda c: c.details(0, MODULE | {"mask": 0x1000}), E_ARGUMENT),
        (lambda c: c.cobs_encode(bytes(32001)), E_ARGUMENT),
        (lambda c: c.serial(PACKET[:-1], 1), E_LENGTH),
        (lambda c: c.serial(PACKET[:-1] + b"\0", 1), E_CRC),
        # a scan that does not fit its modules
        *(
            (lambda c, scan=scan: c.scan(*scan), E_ARGUMENT)
            for scan in (
                ([13], [0], (0, 0)),  # more channels than a module has
                ([1] * 249, [0], (0, 0)),  # more modules than a hub has
                ([], [0], (0, 0)),
                ([12, 11], [0] * 24, (0, 0)),  # one value too many
                ([12, 11], [0] * 19, (0, 5)),
                ([12, 11], [0] * 12, (0, 12)),  # no such channel
                ([12, 11], [0] * 12, (1, 0)),
                ([12, 0], [], (1, 1)),
                ([12, 11], [], (2, 1)),
                ([12, 11], [], (3, 0)),  # no such module
            )
        ),
    ],
)
def test_what_the_wire_cannot_carry_is_refused(
    c_side: CSide, call: Callable[[CSide], object], error: int
) -> None:
    assert call(c_side) == error


def test_no_builder_writes_past_its_room(c_side: CSide) -> None:
    packet = cyskin.encode(Command.VERSION, bytes(range(9)))
    for room in range(12):
        assert c_side.encode(Command.VERSION, bytes(range(9)), room) == E_ROOM
        assert c_side.serial(packet, 1, room) == E_ROOM
    assert c_side.encode(Command.VERSION, bytes(range(9)), 12) == packet
    assert [c_side.cobs_decode(b"\x0612345", room) for room in range(5)] == [E_ROOM] * 5


@pytest.mark.parametrize("blocks", [0, 1, 2, 63, 124])
def test_stuffing_asks_for_the_room_that_its_worst_case_takes(c_side: CSide, blocks: int) -> None:
    """One byte more for each 254, up to the most that can be stuffed."""
    for n in (254 * blocks + more for more in (0, 1, 252, 253)):
        room = n + n // 254 + 1
        assert c_side.cobs_encode(b"\1" * n, room) == serial_link.cobs_encode(b"\1" * n)
        assert c_side.cobs_encode(b"\1" * n, room - 1) == E_ROOM


# What follows holds for any input.

short_ids = st.sampled_from([0, 1, 2, 0xFF])
payloads = st.binary(max_size=30) | st.binary(min_size=200, max_size=255)
any_frame = st.builds(
    Frame,
    st.just(0.0),
    st.builds(int.__or__, st.sampled_from([0x100, 0x200, 0x400, 0x500, 0x300, 0x000]), short_ids),
    st.binary(max_size=8),
    st.sampled_from([False] * 9 + [True]),
)


@st.composite
def traffic(draw: st.DrawFn) -> list[Frame]:
    """Packets' frames, some lost, doubled, damaged or out of place."""
    frames: list[Frame] = []
    for _ in range(draw(st.integers(1, 4))):
        command, ihb = draw(st.integers(0, 255)), draw(short_ids)
        sent = cyskin.to_frames(command, draw(payloads), ihb=ihb)
        at = draw(st.integers(0, len(sent) - 1))
        frames += sent[:at] + draw(st.sampled_from([[], [sent[at]], [sent[at]] * 2]))
        frames += draw(st.lists(any_frame, max_size=2)) + sent[at + 1 :]
    return frames


@given(traffic() | st.lists(any_frame, max_size=60))
def test_both_sides_reassemble_alike(c_side: CSide, frames: list[Frame]) -> None:
    assert c_side.reassemble(frames) == python_reassemble(frames)


@given(st.integers(0, 255), payloads, st.integers(0, 255))
def test_both_sides_send_any_packet_alike(
    c_side: CSide, command: int, payload: bytes, ihb: int
) -> None:
    packet = c_side.encode(command, payload)
    assert packet == cyskin.encode(command, payload)
    assert c_side.fragment(packet, ihb) == cyskin.fragment(packet, ihb)
    assert c_side.serial(packet, ihb) == serial_link.encode(command, payload, ihb=ihb)
    assert c_side.parse(packet) == Packet(0.0, 0, command, payload)


@given(st.sampled_from([*commands.REQUESTS, *WITHOUT_FIELDS]), st.binary(max_size=6))
@examples(150)
def test_both_sides_read_the_fields_of_any_request_alike(
    c_side: CSide, command: Command, payload: bytes
) -> None:
    fields, want = c_side.request(command, payload), commands.parse_request(command, payload)
    assert (fields is None) == (want is None)
    if fields is not None and want is not None:
        read = {**want, **({"on": int(want["on"] != 0)} if "on" in want else {})}
        assert fields == dict.fromkeys(fields, 0) | read


line_parts = st.one_of(
    st.binary(max_size=300),
    st.builds(lambda n: b"\1" * n, st.integers(255, 600)),
    st.builds(
        lambda command, payload, ihb: serial_link.encode(command, payload, ihb=ihb),
        st.integers(0, 255),
        payloads,
        st.integers(0, 255),
    ),
)


@given(st.lists(line_parts, max_size=6), st.lists(st.integers(1, 300), min_size=1, max_size=5))
def test_any_pieces_are_received_as_python_receives_the_whole(
    c_side: CSide, parts: list[bytes], sizes: list[int]
) -> None:
    line = b"".join(parts)
    assert c_side.receive(cut(line, sizes)) == python_receive(line)


@given(st.binary(max_size=300) | st.builds(lambda n: b"\7" * n, st.integers(250, 800)))
def test_both_sides_stuff_alike(c_side: CSide, data: bytes) -> None:
    assert c_side.cobs_encode(data) == serial_link.cobs_encode(data)
    decoded = c_side.cobs_decode(data)
    assert (None if decoded == E_COBS else decoded) == serial_link.cobs_decode(data)


@given(st.data(), st.lists(st.integers(0, 12), min_size=1, max_size=60))
def test_a_scan_from_any_start_fills_the_channels_from_there(
    c_side: CSide, data: st.DataObject, channels: list[int]
) -> None:
    places = [(m, c) for m, n in enumerate(channels) for c in range(n)]
    first = data.draw(st.integers(0, max(len(places) - 1, 0)))
    n = data.draw(st.integers(0, len(places) - first))
    counts = [(7919 * i) & 0xFFFF for i in range(n)]
    packets = c_side.scan(channels, counts, places[first] if places else (0, 0))
    decoder = Decoder(lambda _: [Module(n) for n in channels])
    frames = [frame for packet in packets for frame in cyskin.fragment(packet, 1)]
    scans = [scan for _, ended in decoder.take(frames) for scan in ended] + decoder.flush()
    want = [MISSING] * first + counts + [MISSING] * (len(places) - first - n)
    assert [list(scan.counts) for scan in scans] == ([want] if n else [])
    assert decoder.counters.index_errors == 0


def text_of_vectors() -> str:
    """The vectors as the plain C program reads them."""

    def line(verb: str, *args: str) -> str:
        return " ".join((verb, *(arg or "-" for arg in args)))

    def outcome(case: Case) -> str:
        return " ".join(
            f"{p['ihb']:02X}{p['command']:02X}{p['payload']}" for p in case["delivered"]
        )

    lines = [
        line("packet", f"{c['ihb']:02X}{c['command']:02X}", c["payload"], c["packet"], c["serial"])
        + f" = {c['frames']}"
        for c in VECTORS["packets"]
    ]
    for c in VECTORS["sensor_data"]:
        counts = struct.pack(f">{len(c['counts'])}H", *c["counts"]).hex()
        lines.append(
            line("scan", bytes(c["channels"]).hex(), counts, "=") + " " + " ".join(c["packets"])
        )
    lines += [line("declare", bytes(c["channels"]).hex(), c["packet"]) for c in VECTORS["declare"]]
    lines += [line("details", c["packet"][4:-2], c["packet"]) for c in VECTORS["details"]]
    lines += [f"frames {c['frames']} = {outcome(c)}" for c in VECTORS["frames_in"]]
    lines += [f"serial {c['line']} = {outcome(c)}" for c in VECTORS["serial_in"]]
    lines += [line("cobs", c["data"], c["encoded"]) for c in VECTORS["cobs"]]
    lines += [line("cobs_decode", c["data"], c["encoded"]) for c in VECTORS["cobs_decode"]]
    lines += [line("cobs_bad", encoded) for encoded in VECTORS["cobs_bad"]]
    return "\n".join(lines) + "\n"


def test_vectors_and_damage_pass_the_sanitizers(tmp_path: Path) -> None:
    program, vectors = tmp_path / "vectors_main", tmp_path / "vectors.txt"
    text = text_of_vectors()
    vectors.write_text(text, encoding="utf-8")
    compile_c(*SANITIZED, C / "vectors_main.c", "-o", program)
    done = subprocess.run(
        [program, vectors, str(ROUNDS_OF_DAMAGE)],
        capture_output=True,
        text=True,
        check=False,
        timeout=SECONDS,
        # nothing is allocated but by the program itself, and leaks cannot be looked for in a tracer
        env={**os.environ, "ASAN_OPTIONS": "detect_leaks=0"},
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{text.count(chr(10))} vectors\n"
