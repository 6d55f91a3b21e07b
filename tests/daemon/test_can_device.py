"""CAN interfaces of the kernel, and of python-can, and a source on them.

Datagrams of a Unix socket stand in for the kernel's frames: it stamps and delivers both in the same
way. python-can's virtual bus stands in for an adapter's driver.
"""

import array
import errno
import logging
import os
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from can.interfaces.virtual import VirtualBus

from taxeld.config.tables import SourceConfig
from taxeld.source import bus_faults, socketcan
from taxeld.source.bus_faults import PASSED_S, BusFault
from taxeld.source.device import Device, LostError
from taxeld.source.opening import open_device
from taxeld.source.recorder import Recorder
from taxeld.source.sources import LiveSource, least_period_ms
from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol.frames import Frame
from tests.rig.given_device import GivenDevice
from tests.rig.sessions import items_of
from tests.rig.skins import CHANNELS, LISTED, MODULES, SKIN
from tests.rig.virtual_hub import frames_of

LISTENING: dict[str, Any] = {"listen_only": True, "modules": LISTED}
FRAME = struct.Struct("=IB3x8s")
ERROR, REMOTE = 0x2000_0000, 0x4000_0000
DATA = [
    Frame(0.0, 0x000, b""),
    Frame(0.0, 0x7FF, b"\x01"),
    Frame(0.0, 0x1FFF_FFFF, b"12345678", extended=True),
    Frame(0.0, 0x12, b"\x00\x00", extended=True),
]


class KernelSocket(socket.socket):
    """Tells a fault once, after all that came before it, as the kernel does."""

    fault = 0
    dropped = 0  # frames lost before the next, as the kernel counts them

    def recvmsg(self, *sizes: int) -> Any:
        try:
            data, control, *rest = super().recvmsg(*sizes)
        except BlockingIOError:
            number, self.fault = self.fault, 0
            if number:
                raise OSError(number, os.strerror(number)) from None
            raise
        if self.dropped:
            count = array.array("I", [self.dropped]).tobytes()
            control.append((socket.SOL_SOCKET, socketcan.SO_RXQ_OVFL, count))
        return data, control, *rest


class KernelBus:
    interface = "socketcan"

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        near, self._far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        self._far.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        self._far.setblocking(False)
        self.near = KernelSocket(fileno=near.detach())
        patch.setattr(socketcan, "opened", lambda _: self.near)

    def say(self, frame: Frame, flags: int = 0) -> None:
        number = frame.can_id | 0x8000_0000 * frame.extended | flags
        self._far.send(FRAME.pack(number, len(frame.data), frame.data))

    def lose(self) -> None:
        self.near.fault = errno.ENETDOWN

    def close(self) -> None:
        self.near.close()
        self._far.close()

    def fill(self) -> None:
        with suppress(BlockingIOError):
            while True:
                self.near.send(bytes(FRAME.size))

    def drain(self) -> list[Frame]:
        """What was sent, since it was full last."""
        frames = []
        with suppress(BlockingIOError):
            while True:
                number, size, data = FRAME.unpack(self._far.recv(64))
                extended = number >= 0x8000_0000
                frames.append(Frame(0.0, number & 0x1FFF_FFFF, data[:size], extended))
        return [frame for frame in frames if frame.data]


class PythonCanBus:
    interface = "virtual"

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.heard, self._sent = list[can.Message | Exception](), list[can.Message]()
        self._is_full = False
        patch.setattr(VirtualBus, "recv", self._recv)
        patch.setattr(VirtualBus, "send", self._send)

    def _recv(self, *_: object) -> can.Message | None:
        heard = self.heard.pop(0) if self.heard else None
        if isinstance(heard, Exception):
            raise heard
        return heard

    def _send(self, message: can.Message, **_: object) -> None:
        if self._is_full:
            raise can.CanOperationError("Transmit buffer full")
        self._sent.append(message)

    def say(self, frame: Frame, flags: int = 0, t: float = 0.0) -> None:
        kind = {"is_remote_frame": flags == REMOTE, "is_error_frame": flags == ERROR}
        data = b"" if flags == REMOTE else frame.data
        number, t = frame.can_id, t or time.time()
        self.heard.append(can.Message(t, number, frame.extended, data=data, **kind))

    def lose(self) -> None:
        self.heard.append(can.CanOperationError("down"))

    def close(self) -> None:
        """Nothing is held open."""

    def fill(self) -> None:
        self._is_full = True

    def drain(self) -> list[Frame]:
        sent, self._sent, self._is_full = self._sent, [], False
        return [Frame(0.0, m.arbitration_id, bytes(m.data), m.is_extended_id) for m in sent]


Bus = KernelBus | PythonCanBus


@pytest.fixture(params=[KernelBus, PythonCanBus])
def bus(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bus]:
    with closing(request.param(monkeypatch)) as made:
        yield made


def config_of(bus: Bus, **keys: Any) -> SourceConfig:
    return SourceConfig(kind="can", interface=bus.interface, channel="can0", **keys)


@pytest.fixture
def device(bus: Bus) -> Iterator[Device]:
    with closing(open_device(config_of(bus))) as made:
        yield made


def listener(bus: Bus) -> LiveSource:
    return LiveSource(config_of(bus, **LISTENING), {0: SKIN}, open_device)


def test_frames_come_out_as_they_are_with_the_time_of_each(device: Device, bus: Bus) -> None:
    began = time.time()
    for frame in DATA:
        bus.say(frame)
        bus.say(frame, REMOTE)
        time.sleep(0.002)
    read = device.read()
    assert [frame._replace(t=0.0) for frame in read] == DATA
    assert (device.noticed.foreign, device.noticed.bus.total()) == (4, 0)
    times = [frame.t for frame in read]
    assert all(b - a >= 0.001 for a, b in pairwise(times)), "as they were taken"
    assert began <= times[0] <= times[-1] <= time.time()


def test_all_that_has_come_is_read_in_its_order_and_a_lost_interface_is_told_after_it(
    device: Device, bus: Bus
) -> None:
    for number in range(8):
        bus.say(Frame(0.0, 0x101, bytes([number])))
    bus.lose()
    assert [frame.data for frame in device.read()] == [bytes([number]) for number in range(8)]
    with pytest.raises(LostError) as lost:
        device.read()
    assert "down" in str(lost.value.__cause__)


def test_requests_go_out_are_recorded_and_wait_while_none_is_taken(
    bus: Bus, tmp_path: Path
) -> None:
    with Recorder(tmp_path / "session", moves=False) as recorder:
        source, sent = LiveSource(config_of(bus), {0: SKIN}, open_device, recorder), list[Frame]()
        for tick in range(100):
            if tick == 0:
                bus.fill()
            sent += bus.drain() if tick >= 20 else []
            source.poll(0.01 * tick)
        assert source.counters.unsent == 0
        source.close()
    sent += bus.drain()
    assert sent[0] == Frame(0.0, 0x17FFFFFF, bytes.fromhex("013B00004F6D17"), extended=True)
    assert [item._replace(t=0.0) for item in items_of(tmp_path / "session")] == sent  # type: ignore[call-arg]


# name, classes in the id and bytes of the data (linux/can/error.h), and all that they tell
ERROR_FRAMES: list[tuple[str, int, str, list[str]]] = [
    ("transmit timeout", 0x001, "", ["timeout"]),
    ("lost arbitration in bit 3", 0x002, "03", ["arbitration"]),
    ("controller, unspecified", 0x004, "", ["warning"]),
    ("receive buffer overflow", 0x004, "0001", ["overflow"]),
    ("warning level of received", 0x004, "0004", ["warning"]),
    ("error-passive in receiving", 0x004, "0010", ["passive"]),
    ("error-passive in sending, with counters", 0x204, "0020000000008000", ["passive"]),
    ("error-active again", 0x004, "0040", ["active"]),
    *((f"protocol, bit {n}", 0x008, f"0000{1 << n:02X}", ["error"]) for n in (0, 7)),
    ("no acknowledgement, in its slot", 0x088, "00000019", ["no_ack"]),
    ("a stuff error in the data", 0x088, "0000040A", ["error"]),
    ("transceiver, CAN-H without wire", 0x010, "0000000004", ["transceiver"]),
    ("no acknowledgement", 0x020, "", ["no_ack"]),
    ("bus-off", 0x040, "", ["off"]),
    ("bus error", 0x080, "", ["error"]),
    ("restarted", 0x100, "", ["restarted"]),
    ("counters alone", 0x200, "0000000000000102", []),
    ("a class of the future", 0x400, "", ["error"]),
    ("no class, as other interfaces have it", 0x000, "", ["error"]),
    ("several at once", 0x0E4, "0030", ["off", "no_ack", "passive", "error"]),
]


@pytest.mark.parametrize(
    ("classes", "data", "told"),
    [row[1:] for row in ERROR_FRAMES],
    ids=[row[0] for row in ERROR_FRAMES],
)
def test_each_class_of_error_frames_is_counted_by_its_kind_and_said_with_its_cure(
    bus: Bus, classes: int, data: str, told: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    with closing(listener(bus)) as source:
        for now_s in (0.0, 1.0):
            bus.say(Frame(0.0, classes, bytes.fromhex(data).ljust(8, b"\0")), ERROR)
            source.poll(now_s)
        assert counted(source) == dict.fromkeys(told, 2)
        assert source.decoder.stats()["dropped"]["foreign"] == 0  # type: ignore[index]
        faults = [kind for kind in told if kind not in bus_faults.NORMAL]
        lines = [f"source.channel: {BusFault(kind).line}" for kind in faults[:1]]
        assert caplog.messages == lines, "the gravest, once"
        assert source.waits_for == "".join(lines)
        words = bus_faults.counted(counted(source))
        assert all(f"{kind} 2 ({BusFault(kind).line})" in words for kind in told)


def counted(source: LiveSource) -> dict[str, int]:
    return {str(kind): n for kind, n in source.bus.counts.items() if n}


def test_an_error_frame_of_a_driver_that_has_not_the_kernels_form_is_a_damaged_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("taxeld.source.can_device.AS_THE_KERNEL", [])
    bus = PythonCanBus(monkeypatch)
    with closing(listener(bus)) as source:
        bus.say(Frame(0.0, 0x040, b""), ERROR)
        source.poll(0.0)
        assert counted(source) == {"error": 1}


# time, the error frame that came (or None, or a data frame), and the news in the log
OFF, BACK, ERRORS, NO_ACK = (
    Frame(0.0, classes, bytes((0, data, 0, 0, 0, 0, 0, 0)))
    for classes, data in ((0x040, 0), (0x100, 0), (0x004, 0x20), (0x020, 0))
)
COURSE: list[tuple[float, Frame | None, list[str], bool]] = [
    (0.0, OFF, ["source.channel: bus-off"], True),
    (1000.0, None, [], True),
    (1001.0, BACK, [], True),
    (1001.0 + PASSED_S, None, ["no longer: source.channel: bus-off"], False),
    (2000.0, ERRORS, ["source.channel: error-passive"], True),
    (2001.0, DATA[1], [], False),  # what comes is not waited for
    (2001.0 + PASSED_S, None, ["no longer: source.channel: error-passive"], False),
    (3000.0, NO_ACK, ["source.channel: nothing acknowledges"], True),
    (3000.0 + PASSED_S, None, ["no longer: source.channel: nothing acknowledges"], False),
]


def test_a_bus_that_is_off_is_waited_for_until_it_works_and_an_event_passes_by_itself(
    bus: Bus, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    with closing(listener(bus)) as source:
        for now_s, frame, news, waits in COURSE:
            caplog.clear()
            if frame is not None:
                bus.say(frame, 0 if frame in DATA else ERROR)
            source.poll(now_s)
            said = zip(caplog.messages, news, strict=True)
            assert all(line.startswith(begin) for line, begin in said)
            assert bool(source.waits_for) is waits


def test_frames_that_the_kernel_dropped_are_counted_and_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(KernelBus(monkeypatch)) as kernel, closing(listener(kernel)) as source:
        for dropped in (0, 5, 5, 12):
            kernel.near.dropped = dropped
            kernel.say(Frame(0.0, 0x101, b"a"))
            source.poll(float(dropped))
        assert counted(source) == {"unread": 12}
    (line,) = caplog.messages
    assert "the kernel dropped frames, not read in time" in line


@pytest.mark.parametrize(("behind_s", "kept"), [(0.02, True), (7200.0, True), (1e8, False)])
def test_stamps_of_an_adapters_own_clock_are_replaced_by_the_arrivals(
    monkeypatch: pytest.MonkeyPatch, behind_s: float, kept: bool
) -> None:
    """Some count from their start; the kernel's are believed, however old."""
    bus, stamp = PythonCanBus(monkeypatch), time.time() - behind_s
    bus.say(DATA[1], t=stamp)
    with closing(open_device(config_of(bus))) as device:
        (frame,) = device.read()
    assert (frame.t == stamp) == kept
    assert kept or frame.t > stamp + 1e7


def test_a_bus_without_a_descriptor_is_polled_and_damage_ends_one_reading_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus = PythonCanBus(monkeypatch)
    bus.say(DATA[1])
    bus.heard += [can.Message(is_fd=True), ValueError("damaged")]
    bus.say(DATA[0])
    with closing(open_device(config_of(bus))) as device:
        assert device.fileno() < 0
        read = [[frame._replace(t=0.0) for frame in device.read()] for _ in range(2)]
        assert (read, device.noticed.foreign) == ([[DATA[1]], [DATA[0]]], 1)


@pytest.mark.parametrize(
    ("modules", "source", "least_ms"),
    [
        (60, SourceConfig("can"), 22),  # 189 frames: six packets
        (60, SourceConfig("can", bitrate=500_000), 44),
        (60, SourceConfig("serial"), 0),
        (10, SourceConfig("can"), 4),
        (1, SourceConfig("can"), 1),
    ],
)
def test_the_shortest_period_is_what_the_bus_carries(
    modules: int, source: SourceConfig, least_ms: int
) -> None:
    uid = np.array([sui << 4 | name for sui in range(modules) for name in range(1, 12)])
    assert least_period_ms(source, replace(SKIN, uid=uid)) == least_ms


def test_nothing_is_lost_with_the_device_and_the_rest_of_a_scan_is_said_to_come(
    tmp_path: Path,
) -> None:
    counts = [[1000 * k + i + 1 for i in range(CHANNELS)] for k in range(3)]
    hub, frames = VirtualIhb(MODULES), list[Frame]()
    for k, values in enumerate(counts):
        frames += frames_of(hub.sensor_data(values), t=1.0 + 0.05 * k)
    size, device = len(frames) // 3, GivenDevice()
    with Recorder(tmp_path / "session", moves=False) as recorder:
        source = LiveSource(SourceConfig("can", **LISTENING), {0: SKIN}, lambda _: device, recorder)
        scans, seen = [], []
        for part in (frames[:5], [], frames[5:size], frames[size:-1], frames[-1:], []):
            device.frames = part
            found = source.poll(0.01)
            scans += found
            seen.append((len(found), source.is_coming))
        assert seen == [(0, True), (0, False), (1, False), (1, False), (1, False), (0, False)]
        device.is_lost = True
        source.poll(0.3)
        assert (source.counters.lost, source.device) == (1, None)
        source.close()
    assert [list(scan.counts) for scan in scans] == counts
    assert items_of(tmp_path / "session") == frames
