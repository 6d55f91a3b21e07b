"""Write cyskin.json, the test vectors that the Python and the C side are both held against.

`GOLDEN`, `CHECKS` and `COBS` are typed in from the protocol's description and from published
examples, not computed here, so that two sides which agree with each other are not yet right. So
is how many packets get through in each of the bad cases. The rest comes from the Python side.
"""

import binascii
import json
import random
import struct
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))  # the package beside this folder, installed or not

from taxeld_protocol import commands, cyskin, serial_link  # noqa: E402
from taxeld_protocol.cyskin import MAX_VALUES, Command, Packet, Reassembler  # noqa: E402
from taxeld_protocol.frames import Frame, parse_log_line  # noqa: E402
from taxeld_protocol.modules import Module  # noqa: E402
from taxeld_protocol.serial_link import SerialReader  # noqa: E402

Case = dict[str, Any]

# name, short id, command, payload, frames
GOLDEN = [
    ("discovery ping", 0xFF, 0x10, "", "5FF#100080"),
    ("declare", 0xFF, 0x3C, "", "5FF#3C00D2"),
    ("details of all modules", 0xFF, 0x3D, "FF", "5FF#3D01FFBD"),
    ("sync once", 0xFF, 0x3B, "", "5FF#3B00B9"),
    ("period 50 ms", 0xFF, 0x38, "0032", "5FF#3802003280"),
    ("auto sync on", 0xFF, 0x37, "01", "5FF#370101CE"),
    ("auto sync off", 0xFF, 0x37, "00", "5FF#370100C9"),
    ("all but T0 and T1 of module 9 are cut", 0xFF, 0x47, "090FFC", "5FF#4703090FFCE1"),
    (
        "one module, T0..T11 = 10000..10011",
        0x01,
        0x43,
        "00002710271127122713271427152716271727182719271A271B",
        "101#431A000027102711 201#2712271327142715 201#2716271727182719 401#271A271BA9",
    ),
]
# Both checksums are over b"123456789"; CRC-16 is catalogued as CRC-16/IBM-3740
CHECKS = {"crc8": "FB", "crc16": "29B1"}
# data, encoded: the examples of the COBS paper's algorithm, in the order they are usually listed
COBS = [
    ("00", "0101"),
    ("0000", "010101"),
    ("001100", "01021101"),
    ("11220033", "0311220233"),
    ("11223344", "0511223344"),
    ("11000000", "0211010101"),
]


def _run(n: int) -> bytes:
    """n bytes without a zero."""
    return bytes(i % 255 + 1 for i in range(n))


def _packets() -> list[tuple[str, int, int, bytes]]:
    """Name, short id, command, payload."""
    return [
        ("uid", 7, Command.UID, bytes.fromhex("C15C0001")),
        ("modules in their bootloader: sixty", 7, Command.DECLARE, b"\x3c"),
        ("the same: module 9's serial number", 7, Command.MODULE_DETAILS, b"\x09\x00\x00\x0d\xcf"),
        ("error: busy", 7, Command.ERROR, bytes.fromhex("3BEA")),
        ("fills one frame", 2, Command.VERSION, b"v1.00"),
        ("one byte more than a frame", 2, Command.VERSION, b"v1.001"),
        ("fills two frames", 2, Command.VERSION, b"version 1.000"),
        ("all zeros", 0, 0x00, bytes(64)),
        ("all ones", 0xFF, 0xFF, b"\xff" * 64),
        ("a command that nobody knows", 3, 0xA5, b"\x01\x02"),
        ("the longest", 9, Command.SENSOR_DATA, bytes(range(255))),
        ("the longest without a zero", 9, Command.VERSION, _run(255)),
    ]


def _packet_case(name: str, ihb: int, command: int, payload: bytes) -> Case:
    packet = cyskin.encode(command, payload)
    return {
        "name": name,
        "ihb": ihb,
        "command": command,
        "payload": _hex(payload),
        "packet": _hex(packet),
        "frames": " ".join(map(_text, cyskin.fragment(packet, ihb))),
        "serial": _hex(serial_link.encode(command, payload, ihb=ihb)),
    }


def _sensor_case(name: str, channels: list[int], counts: list[int]) -> Case:
    places = [bytes((m, c)) for m, n in enumerate(channels) for c in range(n)]
    packets = []
    for at in range(0, len(counts), MAX_VALUES):
        values = counts[at : at + MAX_VALUES]
        payload = places[at] + struct.pack(f">{len(values)}H", *values)
        packets.append(_hex(cyskin.encode(Command.SENSOR_DATA, payload)))
    return {"name": name, "channels": channels, "counts": counts, "packets": packets}


def _sensor_cases() -> list[Case]:
    counts = random.Random(1)
    cases = [
        _sensor_case("one module, T0..T11 = 10000..10011", [12], list(range(10000, 10012))),
        _sensor_case("no modules", [], []),
        _sensor_case("no channels", [0, 0], []),
        _sensor_case("the ends of the range", [2], [0, 65535]),
    ]
    for name, channels in [
        ("as many values as a packet takes", [12] * 10 + [6]),
        ("one value more", [12] * 10 + [7]),
        ("a packet that starts inside a module", [11] * 16),
        ("modules without channels at the start, at a packet's end and at the end",
         [0, 0, 12, 0] + [12] * 9 + [6, 0, 0, 3, 0]),
        ("sixty modules", [12] * 60),
    ]:  # fmt: skip
        cases.append(_sensor_case(name, channels, counts.choices(range(65536), k=sum(channels))))
    return cases


def _answer_cases() -> Case:
    """DECLARE of modules with these channel counts, and MODULE_DETAILS of single modules."""
    declare = []
    for channels in ([], [12], [11, 0, 8], [12] * 248):
        packet = cyskin.encode(Command.DECLARE, bytes((len(channels), 0, *channels)))
        declare.append({"channels": channels, "packet": _hex(packet)})
    details = []
    for index, module in [
        (0, Module(11, 1, 0x7FF)),
        (247, Module(12, 0xFFFFFFFF, 0xFFF, 0xF0, 0x50, 2)),
        (9, Module(0, 0x01020304, 0, 0x88, 0xF0, 1)),
        (9, Module(8, 0xDCF, 0x76D, 0x50)),  # cut; either number of channels may be told,
        (9, Module(12, 0xDCF, 0x76D, 0x50)),  # the module sends 8 channels
    ]:
        payload = commands.answer(Command.MODULE_DETAILS, module=index, **asdict(module))
        packet = _hex(cyskin.encode(Command.MODULE_DETAILS, payload))
        details.append({"index": index, **asdict(module), "packet": packet})
    return {"declare": declare, "details": details}


def _frame_cases() -> list[Case]:
    a = list(map(_text, cyskin.to_frames(Command.VERSION, b"a good packet of four frames", ihb=1)))
    b = list(map(_text, cyskin.to_frames(Command.VERSION, b"hub two, three frames", ihb=2)))
    c = list(map(_text, cyskin.to_frames(Command.VERSION, b"hub one, three frames", ihb=1)))
    longest = list(map(_text, cyskin.to_frames(Command.VERSION, _run(255), ihb=1)))
    ping, bad_ping = "501#100080", "501#100081"
    not_full = ["101#10", "201#", "201#03AA", "401#BBCC" + _crc("1003AABBCC")]
    cases = {  # how many packets get through
        "whole": (1, a),
        "two hubs interleaved": (2, [a[0], b[0], a[1], b[1], a[2], b[2], a[3]]),
        "a host's broadcast between": (2, [a[0], a[1], "5FF#3B00B9", a[2], a[3]]),
        "first fragment lost": (1, [*a[1:], *a]),
        "middle fragment lost": (1, [a[0], a[1], a[3], *a]),
        "last fragment lost": (1, [*a[:3], *a]),
        "last fragment lost, then a single": (1, [*a[:3], ping, a[3]]),
        "first fragment twice": (1, [a[0], *a]),
        "middle fragments swapped": (1, [a[0], a[2], a[1], a[3], *a]),
        "middle fragment twice": (1, [a[0], a[1], a[1], a[2], a[3], *a]),
        "last fragment twice": (1, [*a, a[3]]),
        "a gap that another hub does not fill": (1, [a[0], a[1], b[1], "402#", a[3], *a]),
        "wrong checksum in a single": (1, [bad_ping, ping]),
        "wrong checksum in four": (1, [a[0], a[1], _flipped(a[2]), a[3], *a]),
        "nothing in a single": (1, ["501#", ping]),
        "two bytes in a single": (1, ["501#1000", ping]),
        "N is more than there is": (1, ["501#1001FF", "501#10FF000000000000", ping]),
        "N is less than there is": (1, ["501#100080DEADBEEF00"]),
        "as much after a packet as fills its fragment": (1, [*a[:3], a[3] + "00" * 1]),
        "a last fragment after the last": (1, ["101#100080", "401#1122334455667788", ping]),
        "seven bytes after a packet, in two fragments": (1, ["101#100080", "401#11223344556677"]),
        "a packet's end lost, and the next one's beginning": (1, [*a[:3], *c[1:], *a]),
        "fragments that are not full": (1, not_full),
        "not complete": (0, a[:3]),
        "a command that nobody knows": (1, ["501#A50102" + _crc("A50102")]),
        "ids that are no fragment": (0, ["001#100080", "301#100080", "601#100080", "701#100080"]),
        "a foreign id inside a packet": (1, [a[0], a[1], "601#100080", a[2], a[3]]),
        "extended ids": (1, [a[0], a[1], "00000501#100080", "1FFFFF01#00", a[2], a[3]]),
        "the longest": (1, longest),
        "one fragment too many": (1, [*longest[:-1], longest[1], longest[-1], ping]),
        "middle fragments without end": (1, [longest[0], *longest[1:2] * 70, ping]),
    }
    return [_frame_case(name, frames, through) for name, (through, frames) in cases.items()]


def _frame_case(name: str, texts: list[str], through: int) -> Case:
    reassembler = Reassembler()
    frames = [frame for text in texts if (frame := parse_log_line(text))]
    packets = [packet for frame in frames if (packet := reassembler.feed(frame))]
    return {
        "name": name,
        "frames": " ".join(texts),
        "delivered": _delivered(name, packets, through),
        "counters": asdict(reassembler.counters),
        "pending": reassembler.pending,
    }


def _serial_cases() -> list[Case]:
    a = serial_link.encode(Command.VERSION, b"a line\x00with a zero", ihb=1)
    b = serial_link.encode(Command.SYNC, ihb=0xFF)
    longest = serial_link.encode(Command.VERSION, _run(255), ihb=9)
    crc_8 = serial_link.cobs_encode(b"\x01" + cyskin.encode(Command.PING)) + b"\0"
    cases = {  # how many packets get through
        "whole": (1, a),
        "two lines": (2, a + b),
        "joined in the middle of a line": (1, a[5:] + b),
        "not complete": (1, a + b[:-1]),
        "delimiters between": (2, b"\0\0\0" + a + b"\0" + b),
        "a byte lost": (1, a[:6] + a[7:] + b),
        "a delimiter lost": (1, a[:-1] + b + a),
        "a bit flipped": (1, a[:6] + bytes((a[6] ^ 0x40,)) + a[7:] + b),
        "the packet's own CRC-8": (1, crc_8 + b),
        "a code that points past the end": (1, b"\x09\x01\x02\0" + b),
        "N is more than there is": (1, _line("01100200") + b),
        "N is less than there is": (1, _line("01100000") + b),
        "too short": (1, b"\x01\0" + _line("0110") + b),
        "the longest": (2, longest + b),
        "one byte longer than the longest": (1, _run(263) + b"\0" + b),
        "noise without end": (0, _run(1000)),
        "noise, then a line": (1, _run(1000) + b"\0" + b),
    }
    return [_serial_case(name, line, through) for name, (through, line) in cases.items()]


def _serial_case(name: str, line: bytes, through: int) -> Case:
    reader = SerialReader()
    packets = reader.feed(line, 0.0)
    return {
        "name": name,
        "line": _hex(line),
        "delivered": _delivered(name, packets, through),
        "counters": asdict(reader.counters),
        "pending": reader.pending,
    }


def _cobs_cases() -> list[Case]:
    computed = [b"", *(_run(n) for n in (1, 253, 254, 255, 508, 509))]
    computed += [_run(n) + b"\0" for n in (253, 254, 255)]
    computed += [b"\0" + _run(n) for n in (253, 254, 255)]
    computed += [bytes(255), _run(254) + b"\0" + _run(254)]
    pairs = COBS + [(_hex(data), _hex(serial_link.cobs_encode(data))) for data in computed]
    return [{"data": data, "encoded": encoded} for data, encoded in pairs]


def vectors() -> Case:
    """All of the file."""
    return {
        "about": [
            "Test vectors of both sides of the protocol, written by make.py. Hex throughout;"
            " frames as id#data; counts decimal. `frames_in` and `serial_in`: what goes in,"
            " what is delivered and counted."
        ],
        "checks": [CHECKS],
        "golden": [
            {"name": name, "ihb": ihb, "command": command, "payload": payload, "frames": frames}
            for name, ihb, command, payload, frames in GOLDEN
        ],
        "packets": [_packet_case(*packet) for packet in _packets()],
        "sensor_data": _sensor_cases(),
        **_answer_cases(),
        "frames_in": _frame_cases(),
        "serial_in": _serial_cases(),
        "cobs": _cobs_cases(),
        # other encoders end a run of 254 without the last 01; a decoder takes both
        "cobs_decode": [{"data": _hex(_run(254)), "encoded": "FF" + _hex(_run(254))}],
        "cobs_bad": ["00", "0100", "02", "0311", "FF" + _hex(_run(253)), "031100", "02110505"],
    }


def render() -> str:
    """The file's text: a line a case."""
    sections = (
        f"{json.dumps(name)}: [\n" + ",\n".join(json.dumps(case) for case in cases) + "\n]"
        for name, cases in vectors().items()
    )
    return "{\n" + ",\n".join(sections) + "\n}\n"


def _hex(data: bytes) -> str:
    return data.hex().upper()


def _text(frame: Frame) -> str:
    return f"{frame.can_id:03X}#{_hex(frame.data)}"


def _delivered(name: str, packets: list[Packet], through: int) -> list[Case]:
    if len(packets) != through:
        raise ValueError(f"{name}: {len(packets)} packets got through, {through} should")
    return [{"ihb": p.ihb, "command": p.command, "payload": _hex(p.payload)} for p in packets]


def _crc(body: str) -> str:
    return f"{cyskin.crc8(bytes.fromhex(body)):02X}"


def _flipped(text: str) -> str:
    """The frame with its last bit the other way."""
    return text[:-1] + f"{int(text[-1], 16) ^ 1:X}"


def _line(body: str) -> bytes:
    """A line with a good checksum, whatever its body says."""
    data = bytes.fromhex(body)
    crc = binascii.crc_hqx(data, 0xFFFF).to_bytes(2, "big")
    return serial_link.cobs_encode(data + crc) + serial_link.DELIMITER


if __name__ == "__main__":
    (HERE / "cyskin.json").write_text(render(), encoding="utf-8")
