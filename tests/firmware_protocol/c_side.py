"""The C side as Python values: built here, driven through ctypes. Its structs are mirrored."""

import ctypes
import os
import shlex
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import LinkCounters, Packet
from taxeld_protocol.frames import Frame
from taxeld_protocol.serial_link import SerialCounters

C = Path(__file__).parents[2] / "firmware_protocol" / "c"
SANITIZED = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
STRICT = ["-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic"]

GOOD, E_ARGUMENT, E_ROOM, E_LENGTH, E_CRC, E_COBS = 1, -1, -2, -3, -4, -7
PACKET_MAX, LINE_MAX = 258, 263

u8, u16, u32, size_t = ctypes.c_uint8, ctypes.c_uint16, ctypes.c_uint32, ctypes.c_size_t
pointer, flag, ref = ctypes.c_void_p, ctypes.c_bool, ctypes.byref


def struct(**members: Any) -> Any:
    """A type of the header, of members in their order."""
    return type("Struct", (ctypes.Structure,), {"_fields_": list(members.items())})


def counters_of(kind: type) -> dict[str, Any]:
    return {field.name: u32 for field in fields(kind)}


CPacket = struct(ihb=u8, command=u8, n=u8, payload=pointer)
CFrame = struct(id=u32, extended=flag, len=u8, data=u8 * 8)
CModule = struct(sui=u32, mask=u16, channels=u8, grouping=u8, cdc_control=u8, cdc_speed=u8)
CRequest = struct(uid=u32, short_id=u8, on=flag, period_ms=u16, module=u8, cut=u16)
CHub = struct(
    uid=u32, module=pointer, modules=size_t, phase=ctypes.c_int, short_id=u8,
    auto_sync=flag, period_ms=u16, asked=u8, error=u8, at=size_t, end=size_t,
)  # fmt: skip
CScan = struct(
    channels=pointer, modules=size_t, module=size_t, channel=size_t, counts=pointer, left=size_t
)
CFragmenter = struct(packet=pointer, len=size_t, at=size_t, ihb=u8)
CLinkCounters = struct(**counters_of(LinkCounters))
CReassembler = struct(data=u8 * 264, len=size_t, pending=u32, short_id=u8, counters=CLinkCounters)
CSerialCounters = struct(**counters_of(SerialCounters))
CReceiver = struct(line=u8 * 262, len=size_t, overrun=flag, counters=CSerialCounters)

MIRRORS = [
    *(CPacket, CFrame, CModule, CRequest, CHub, CScan, CFragmenter),
    *(CLinkCounters, CReassembler, CSerialCounters, CReceiver),
]


def packet_of(made: Any) -> Packet:
    return Packet(0.0, made.ihb, made.command, ctypes.string_at(made.payload or 0, made.n))


def c_packet(ihb: int, command: int, payload: bytes) -> tuple[Any, object]:
    """A packet, and what has to outlive it."""
    held = ctypes.create_string_buffer(payload, max(len(payload), 1))
    return CPacket(ihb, command, len(payload), ctypes.addressof(held)), held


def sized(data: bytes) -> tuple[bytes, Any]:
    return data, size_t(len(data))


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
        self.c.taxeld_fragmenter_next.restype = flag
        self.c.taxeld_request_parse.restype = flag

    def _built(self, room: int, name: str, *args: Any, state: Any = None) -> bytes | int:
        """What a builder writes; one with a state takes that first."""
        out = ctypes.create_string_buffer(max(room, 1))
        first = () if state is None else (ref(state),)
        n = getattr(self.c, f"taxeld_{name}")(*first, out, size_t(room), *args)
        return n if n < 0 else out.raw[:n]

    def encode(self, command: int, payload: bytes, room: int = PACKET_MAX) -> bytes | int:
        return self._built(room, "packet_encode", u8(command), *sized(payload))

    def declare(self, channels: Sequence[int]) -> bytes | int:
        return self._built(PACKET_MAX, "declare_encode", *sized(bytes(channels)))

    def details(self, index: int, module: dict[str, int]) -> bytes | int:
        return self._built(PACKET_MAX, "details_encode", u8(index), ref(CModule(**module)))

    def serial(self, packet: bytes, ihb: int, room: int = LINE_MAX) -> bytes | int:
        return self._built(room, "serial_encode", *sized(packet), u8(ihb))

    def cobs_encode(self, data: bytes, room: int | None = None) -> bytes | int:
        room = len(data) + len(data) // 254 + 1 if room is None else room
        return self._built(room, "cobs_encode", *sized(data))

    def cobs_decode(self, data: bytes, room: int | None = None) -> bytes | int:
        return self._built(len(data) if room is None else room, "cobs_decode", *sized(data))

    def parse(self, data: bytes) -> Packet | int:
        packet = CPacket()
        status: int = self.c.taxeld_packet_parse(ref(packet), *sized(data))
        return packet_of(packet) if status == GOOD else status

    def request(self, command: int, payload: bytes) -> dict[str, int] | None:
        """All fields of a request; None where its length is refused."""
        fields, (packet, _) = CRequest(), c_packet(0, command, payload)
        taken = self.c.taxeld_request_parse(ref(fields), ref(packet))
        return {name: int(getattr(fields, name)) for name, _ in fields._fields_} if taken else None

    def fragment(self, packet: bytes, ihb: int) -> list[Frame] | int:
        state, made, frames = CFragmenter(), CFrame(), list[Frame]()
        status: int = self.c.taxeld_fragmenter_init(ref(state), *sized(packet), u8(ihb))
        while self.c.taxeld_fragmenter_next(ref(state), ref(made)):
            frames.append(Frame(0.0, made.id, bytes(made.data[: made.len]), made.extended))
        return frames if status == 0 else status

    def hub(self, uid: int, modules: Sequence[dict[str, int]], phase: int) -> Any:
        hub, table = CHub(), (CModule * len(modules))(*(CModule(**module) for module in modules))
        self.c.taxeld_hub_init(ref(hub), u32(uid), table, size_t(len(modules)), phase)
        hub.held = table
        return hub

    def answers(self, hub: Any, packet: Packet) -> list[bytes | int]:
        """What a hub answers to a request."""
        request, _held = c_packet(packet.ihb, packet.command, packet.payload)
        self.c.taxeld_hub_hear(ref(hub), ref(request))
        return list(iter(lambda: self._built(PACKET_MAX, "hub_answer", state=hub), b""))

    def scan(
        self, channels: Sequence[int], counts: Sequence[int], start: tuple[int, int] = (0, 0)
    ) -> list[bytes] | int:
        state, table = CScan(), bytes(channels)
        values = (u16 * max(len(counts), 1))(*counts)
        place = map(size_t, start)
        status: int = self.c.taxeld_scan_init(
            ref(state), *sized(table), *place, values, size_t(len(counts))
        )
        packets: list[bytes] = []
        while packet := self._built(PACKET_MAX, "scan_next", state=state):
            if not isinstance(packet, bytes):
                break
            packets.append(packet)
        return packets if status == 0 else status

    def reassemble(self, frames: Iterable[Frame]) -> tuple[list[Packet], dict[str, int], int]:
        """What 256 reassemblers, one a short id, deliver, count together, and still hold."""
        hubs: dict[int, Any] = {}
        packet, delivered = CPacket(), []
        for frame in frames:
            ihb = frame.can_id & cyskin.SHORT_ID_MASK
            if ihb not in hubs:
                hubs[ihb] = CReassembler()
                self.c.taxeld_reassembler_init(ref(hubs[ihb]), u8(ihb))
            data = (u8 * 8)(*frame.data)
            fed = CFrame(frame.can_id, frame.extended, len(frame.data), data)
            if self.c.taxeld_reassembler_feed(ref(hubs[ihb]), ref(fed), ref(packet)) == GOOD:
                delivered.append(packet_of(packet))
        counters = {
            name: sum(getattr(hub.counters, name) for hub in hubs.values())
            for name in counters_of(LinkCounters)
        }
        return delivered, counters, sum(hub.pending for hub in hubs.values())

    def receive(self, pieces: Iterable[bytes]) -> tuple[list[Packet], dict[str, int], int]:
        """What a receiver fed these pieces delivers, counts, and still holds."""
        state, packet, delivered = CReceiver(), CPacket(), []
        take = self.c.taxeld_receiver_take
        self.c.taxeld_receiver_init(ref(state))
        for piece in pieces:
            block = ctypes.create_string_buffer(piece, max(len(piece), 1))
            at, left = pointer(ctypes.addressof(block)), size_t(len(piece))
            while take(ref(state), ref(at), ref(left), ref(packet)) == GOOD:
                delivered.append(packet_of(packet))
            assert left.value == 0
        counters = {name: getattr(state.counters, name) for name in counters_of(SerialCounters)}
        return delivered, counters, state.len
