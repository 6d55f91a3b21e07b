"""The C side as Python values: built here, driven through ctypes. Its structs are mirrored."""

import ctypes
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import LinkCounters, Packet
from taxeld_protocol.frames import Frame
from taxeld_protocol.serial_link import SerialCounters

C = Path(__file__).parents[2] / "firmware_protocol" / "c"
STRICT = ["-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic"]

GOOD, E_ARGUMENT, E_ROOM, E_LENGTH, E_CRC, E_COBS = 1, -1, -2, -3, -4, -7
PACKET_MAX, LINE_MAX = 258, 263

u8, u16, u32, size_t = ctypes.c_uint8, ctypes.c_uint16, ctypes.c_uint32, ctypes.c_size_t
pointer = ctypes.c_void_p


class CPacket(ctypes.Structure):
    _fields_ = [("ihb", u8), ("command", u8), ("n", u8), ("payload", pointer)]

    def value(self) -> Packet:
        payload = ctypes.string_at(self.payload or 0, self.n)
        return Packet(0.0, self.ihb, self.command, payload)


class CFrame(ctypes.Structure):
    _fields_ = [("id", u32), ("extended", ctypes.c_bool), ("len", u8), ("data", u8 * 8)]

    def value(self) -> Frame:
        return Frame(0.0, self.id, bytes(self.data[: self.len]), self.extended)


class CModule(ctypes.Structure):
    _fields_ = [
        ("sui", u32),
        ("mask", u16),
        ("channels", u8),
        ("grouping", u8),
        ("cdc_control", u8),
        ("cdc_speed", u8),
    ]


class CRequest(ctypes.Structure):
    _fields_ = [
        ("uid", u32),
        ("short_id", u8),
        ("on", ctypes.c_bool),
        ("period_ms", u16),
        ("module", u8),
        ("cut", u16),
    ]


class CHub(ctypes.Structure):
    _fields_ = [
        ("uid", u32),
        ("module", pointer),
        ("modules", size_t),
        ("phase", ctypes.c_int),
        ("short_id", u8),
        ("auto_sync", ctypes.c_bool),
        ("period_ms", u16),
        ("asked", u8),
        ("error", u8),
        ("at", size_t),
        ("end", size_t),
    ]


class CScan(ctypes.Structure):
    _fields_ = [
        ("channels", pointer),
        ("modules", size_t),
        ("module", size_t),
        ("channel", size_t),
        ("counts", pointer),
        ("left", size_t),
    ]


class CFragmenter(ctypes.Structure):
    _fields_ = [("packet", pointer), ("len", size_t), ("at", size_t), ("ihb", u8)]


class CLinkCounters(ctypes.Structure):
    _fields_ = [(field.name, u32) for field in fields(LinkCounters)]


class CReassembler(ctypes.Structure):
    _fields_ = [
        ("data", u8 * 264),
        ("len", size_t),
        ("pending", u32),
        ("short_id", u8),
        ("counters", CLinkCounters),
    ]


class CSerialCounters(ctypes.Structure):
    _fields_ = [(field.name, u32) for field in fields(SerialCounters)]


class CReceiver(ctypes.Structure):
    _fields_ = [
        ("line", u8 * 262),
        ("len", size_t),
        ("overrun", ctypes.c_bool),
        ("counters", CSerialCounters),
    ]


MIRRORS = [
    CPacket,
    CFrame,
    CModule,
    CRequest,
    CHub,
    CScan,
    CFragmenter,
    CLinkCounters,
    CReassembler,
    CSerialCounters,
    CReceiver,
]


def c_packet(ihb: int, command: int, payload: bytes) -> tuple[CPacket, object]:
    """A packet, and what has to outlive it."""
    held = ctypes.create_string_buffer(payload, max(len(payload), 1))
    return CPacket(ihb, command, len(payload), ctypes.addressof(held)), held


def compile_c(*args: str | Path) -> None:
    compiler = shlex.split(os.environ.get("CC", "cc"))
    if shutil.which(compiler[0]) is None:
        pytest.fail(f"no C compiler ({compiler[0]}): apt-get install gcc libc6-dev", pytrace=False)
    done = subprocess.run([*compiler, *STRICT, *args], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


class CSide:
    """The library, its results as Python values; an error is its negative status."""

    def __init__(self, path: Path) -> None:
        self.c = ctypes.CDLL(str(path))
        self.c.taxeld_fragmenter_next.restype = ctypes.c_bool
        self.c.taxeld_request_parse.restype = ctypes.c_bool
        self.c.taxeld_crc8.restype, self.c.taxeld_crc16.restype = u8, u16

    def _built(self, room: int, call: Callable[[Any, ctypes.c_size_t], int]) -> bytes | int:
        out = ctypes.create_string_buffer(max(room, 1))
        n = call(out, size_t(room))
        return n if n < 0 else out.raw[:n]

    def crc(self, data: bytes) -> tuple[int, int]:
        """CRC-8 and CRC-16."""
        n = size_t(len(data))
        return self.c.taxeld_crc8(data, n), self.c.taxeld_crc16(data, n)

    def encode(self, command: int, payload: bytes, room: int = PACKET_MAX) -> bytes | int:
        return self._built(
            room,
            lambda out, n: self.c.taxeld_packet_encode(
                out, n, u8(command), payload, size_t(len(payload))
            ),
        )

    def discovery(self, uid: int) -> bytes | int:
        return self._built(
            PACKET_MAX, lambda out, n: self.c.taxeld_discovery_encode(out, n, u32(uid))
        )

    def declare(self, channels: Sequence[int]) -> bytes | int:
        return self._built(
            PACKET_MAX,
            lambda out, n: self.c.taxeld_declare_encode(
                out, n, bytes(channels), size_t(len(channels))
            ),
        )

    def details(self, index: int, module: dict[str, int]) -> bytes | int:
        told = ctypes.byref(CModule(**module))
        return self._built(
            PACKET_MAX, lambda out, n: self.c.taxeld_details_encode(out, n, u8(index), told)
        )

    def serial(self, packet: bytes, ihb: int, room: int = LINE_MAX) -> bytes | int:
        return self._built(
            room,
            lambda out, n: self.c.taxeld_serial_encode(
                out, n, packet, size_t(len(packet)), u8(ihb)
            ),
        )

    def cobs_encode(self, data: bytes, room: int | None = None) -> bytes | int:
        room = len(data) + len(data) // 254 + 1 if room is None else room
        return self._built(
            room, lambda out, n: self.c.taxeld_cobs_encode(out, n, data, size_t(len(data)))
        )

    def cobs_decode(self, data: bytes, room: int | None = None) -> bytes | int:
        room = len(data) if room is None else room
        return self._built(
            room, lambda out, n: self.c.taxeld_cobs_decode(out, n, data, size_t(len(data)))
        )

    def parse(self, data: bytes) -> Packet | int:
        packet = CPacket()
        status: int = self.c.taxeld_packet_parse(ctypes.byref(packet), data, size_t(len(data)))
        return packet.value() if status == GOOD else status

    def request(self, command: int, payload: bytes) -> dict[str, int] | None:
        """All fields of a request; None where its length is refused."""
        fields, (packet, _) = CRequest(), c_packet(0, command, payload)
        taken = self.c.taxeld_request_parse(ctypes.byref(fields), ctypes.byref(packet))
        return {name: int(getattr(fields, name)) for name, _ in fields._fields_} if taken else None

    def fragment(self, packet: bytes, ihb: int) -> list[Frame] | int:
        state, frame = CFragmenter(), CFrame()
        status: int = self.c.taxeld_fragmenter_init(
            ctypes.byref(state), packet, size_t(len(packet)), u8(ihb)
        )
        frames = []
        while self.c.taxeld_fragmenter_next(ctypes.byref(state), ctypes.byref(frame)):
            frames.append(frame.value())
        return frames if status == 0 else status

    def hub(self, uid: int, modules: Sequence[dict[str, int]], phase: int) -> CHub:
        hub, table = CHub(), (CModule * len(modules))(*(CModule(**module) for module in modules))
        self.c.taxeld_hub_init(ctypes.byref(hub), u32(uid), table, size_t(len(modules)), phase)
        hub.held = table
        return hub

    def answers(self, hub: CHub, packet: Packet) -> list[bytes | int]:
        """What a hub answers to a request."""
        request, _held = c_packet(packet.ihb, packet.command, packet.payload)
        self.c.taxeld_hub_hear(ctypes.byref(hub), ctypes.byref(request))

        def step() -> bytes | int:
            return self._built(
                PACKET_MAX, lambda out, n: self.c.taxeld_hub_answer(ctypes.byref(hub), out, n)
            )

        return list(iter(step, b""))

    def scan(
        self, channels: Sequence[int], counts: Sequence[int], start: tuple[int, int] = (0, 0)
    ) -> list[bytes] | int:
        state, table = CScan(), bytes(channels)
        values = (u16 * max(len(counts), 1))(*counts)
        status: int = self.c.taxeld_scan_init(
            ctypes.byref(state),
            table,
            size_t(len(table)),
            *map(size_t, start),
            values,
            size_t(len(counts)),
        )
        packets: list[bytes] = []

        def step() -> bytes | int:
            return self._built(
                PACKET_MAX, lambda out, n: self.c.taxeld_scan_next(ctypes.byref(state), out, n)
            )

        while isinstance(packet := step(), bytes) and packet:
            packets.append(packet)
        return packets if status == 0 else status

    def reassemble(self, frames: Iterable[Frame]) -> tuple[list[Packet], dict[str, int], int]:
        """What 256 reassemblers, one a short id, deliver, count together, and still hold."""
        hubs: dict[int, CReassembler] = {}
        packet, delivered = CPacket(), []
        for frame in frames:
            ihb = frame.can_id & cyskin.SHORT_ID_MASK
            if ihb not in hubs:
                hubs[ihb] = CReassembler()
                self.c.taxeld_reassembler_init(ctypes.byref(hubs[ihb]), u8(ihb))
            data = (u8 * 8)(*frame.data)
            fed = CFrame(frame.can_id, frame.extended, len(frame.data), data)
            if (
                self.c.taxeld_reassembler_feed(
                    ctypes.byref(hubs[ihb]), ctypes.byref(fed), ctypes.byref(packet)
                )
                == GOOD
            ):
                delivered.append(packet.value())
        counters = {
            field.name: sum(getattr(hub.counters, field.name) for hub in hubs.values())
            for field in fields(LinkCounters)
        }
        return delivered, counters, sum(hub.pending for hub in hubs.values())

    def receive(self, pieces: Iterable[bytes]) -> tuple[list[Packet], dict[str, int], int]:
        """What a receiver fed these pieces delivers, counts, and still holds."""
        state, packet, delivered = CReceiver(), CPacket(), []
        self.c.taxeld_receiver_init(ctypes.byref(state))
        for piece in pieces:
            block = ctypes.create_string_buffer(piece, max(len(piece), 1))
            at, left = pointer(ctypes.addressof(block)), size_t(len(piece))
            while (
                self.c.taxeld_receiver_take(
                    ctypes.byref(state), ctypes.byref(at), ctypes.byref(left), ctypes.byref(packet)
                )
                == GOOD
            ):
                delivered.append(packet.value())
            assert left.value == 0
        counters = {f.name: getattr(state.counters, f.name) for f in fields(SerialCounters)}
        return delivered, counters, state.len
