"""The Python side against the test vectors, and the vectors against their script."""

import binascii
import doctest
import json
import runpy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol import cyskin, serial_link
from taxeld_protocol.cyskin import Command, Packet, Reassembler
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.frames import Frame, parse_log_line
from taxeld_protocol.modules import Module, ModuleTable
from taxeld_protocol.serial_link import SerialReader

FOLDER = Path(__file__).parents[2] / "firmware_protocol" / "vectors"
VECTORS: dict[str, list[Any]] = json.loads((FOLDER / "cyskin.json").read_text(encoding="utf-8"))


def each(section: str) -> pytest.MarkDecorator:
    """A test a case of the section, under the case's name."""
    cases = VECTORS[section]
    ids = [str(case.get("name", i)) for i, case in enumerate(cases)]
    return pytest.mark.parametrize("case", cases, ids=ids)


def frames_of(text: str) -> list[Frame]:
    frames = [parse_log_line(word) for word in text.split()]
    assert None not in frames
    return [frame for frame in frames if frame is not None]


def delivered(packets: list[Packet]) -> list[dict[str, Any]]:
    return [
        {"ihb": p.ihb, "command": p.command, "payload": p.payload.hex().upper()} for p in packets
    ]


def test_the_file_is_what_its_script_makes() -> None:
    script = runpy.run_path(str(FOLDER / "make.py"))
    assert (FOLDER / "cyskin.json").read_text(encoding="utf-8") == script["render"]()


def test_checksums_have_their_published_values() -> None:
    [checks] = VECTORS["checks"]
    assert checks == {"crc8": "FB", "crc16": "29B1"}
    assert cyskin.crc8(b"123456789") == 0xFB
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1


def test_the_examples_of_the_document_print_what_it_says() -> None:
    document = FOLDER.parents[1] / "docs" / "protocol.md"
    failed, tried = doctest.testfile(str(document), module_relative=False)
    assert tried > 20
    assert failed == 0


@each("golden")
def test_golden_frames_are_sent_and_understood(case: dict[str, Any]) -> None:
    frames = frames_of(case["frames"])
    payload = bytes.fromhex(case["payload"])
    assert cyskin.to_frames(case["command"], payload, ihb=case["ihb"]) == frames
    reassembler = Reassembler()
    packets = [packet for frame in frames if (packet := reassembler.feed(frame))]
    assert packets == [Packet(0.0, case["ihb"], case["command"], payload)]


@each("packets")
def test_packets_are_encoded_alike(case: dict[str, Any]) -> None:
    ihb, command, payload = case["ihb"], case["command"], bytes.fromhex(case["payload"])
    packet = cyskin.encode(command, payload)
    assert packet == bytes.fromhex(case["packet"])
    assert cyskin.fragment(packet, ihb) == frames_of(case["frames"])
    assert serial_link.encode(command, payload, ihb=ihb) == bytes.fromhex(case["serial"])


@each("sensor_data")
def test_a_scan_is_packed_and_walked_alike(case: dict[str, Any]) -> None:
    hub = VirtualIhb([Module(n) for n in case["channels"]])
    packets = [cyskin.encode(*answer) for answer in hub.sensor_data(case["counts"])]
    assert [packet.hex().upper() for packet in packets] == case["packets"]
    decoder = Decoder(lambda _: hub.modules)
    frames = [frame for packet in packets for frame in cyskin.fragment(packet, 1)]
    scans = [scan for _, ended in decoder.take(frames) for scan in ended]
    assert [list(scan.counts) for scan in scans] == [case["counts"]] * bool(case["counts"])


@each("declare")
def test_declare_answers_are_understood(case: dict[str, Any]) -> None:
    table = ModuleTable()
    assert table.on_declare(payload_of(case["packet"], Command.DECLARE))
    assert [module.channels for module in table.modules] == case["channels"]


@each("details")
def test_details_answers_are_understood(case: dict[str, Any]) -> None:
    """As many channels as the mask has bits are sent, whatever number is told."""
    table = ModuleTable()
    assert table.on_declare(bytes((case["index"], 0)) + bytes(case["index"]))
    assert table.on_details(payload_of(case["packet"], Command.MODULE_DETAILS))
    module = asdict(table.modules[case["index"]])
    sent = case["mask"].bit_count()
    told = {key: value for key, value in case.items() if key not in ("index", "packet")}
    assert module == told | {"channels": sent}


def payload_of(packet: str, command: int) -> bytes:
    [(got, _)] = Decoder().take(cyskin.fragment(bytes.fromhex(packet), 1))
    assert got.command == command
    return got.payload


@each("frames_in")
def test_damaged_frames_deliver_and_count_alike(case: dict[str, Any]) -> None:
    reassembler = Reassembler()
    fed = [reassembler.feed(frame) for frame in frames_of(case["frames"])]
    assert delivered([packet for packet in fed if packet]) == case["delivered"]
    assert asdict(reassembler.counters) == case["counters"]
    assert reassembler.pending == case["pending"]


@each("serial_in")
def test_damaged_lines_deliver_and_count_alike(case: dict[str, Any]) -> None:
    reader = SerialReader()
    assert delivered(reader.feed(bytes.fromhex(case["line"]), 0.0)) == case["delivered"]
    assert asdict(reader.counters) == case["counters"]
    assert reader.pending == case["pending"]


def test_stuffing_is_encoded_alike_and_undone_also_that_of_other_encoders_or_refused() -> None:
    for case in VECTORS["cobs"]:
        assert serial_link.cobs_encode(bytes.fromhex(case["data"])).hex().upper() == case["encoded"]
    for case in (*VECTORS["cobs"], *VECTORS["cobs_decode"]):
        assert serial_link.cobs_decode(bytes.fromhex(case["encoded"])) == bytes.fromhex(
            case["data"]
        )
    for encoded in VECTORS["cobs_bad"]:
        assert serial_link.cobs_decode(bytes.fromhex(encoded)) is None
