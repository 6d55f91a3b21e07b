"""Sources on the kernel's CAN interfaces.

Datagrams of a Unix socket stand in for the kernel's frames: it stamps and delivers both in the same
way.
"""

import array
import contextlib
import errno
import itertools
import logging
import os
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.config.tables import SourceConfig
from taxeld.source import bus_faults, socketcan
from taxeld.source.bus_faults import PASSED_S, BusFault
from taxeld.source.device import LostError
from taxeld.source.opening import open_device
from taxeld.source.recorder import Recorder
from taxeld.source.socketcan import SocketCanDevice
from taxeld.source.sources import LiveSource, least_period_ms
from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command
from taxeld_protocol.frames import Frame
from tests.rig.conversations import NAMES, hold_host, load
from tests.rig.given_device import GivenDevice
from tests.rig.sessions import items_of
from tests.rig.skins import CHANNELS, LISTED, MODULES, SKIN
from tests.rig.virtual_hub import frames_of

LISTENING: dict[str, Any] = {"listen_only": True, "modules": LISTED}
CONFIG = SourceConfig(kind="can", channel="can0", **LISTENING)
FRAME = struct.Struct("=IB3x8s")


class DaemonSource:
    """As `tests.rig.conversations.Host`."""

    def __init__(self, config: SourceConfig) -> None:
        self.taxels: dict[int, int] = {}
        self._bus = GivenDevice()
        self._source = LiveSource(config, {0: SKIN}, lambda _: self._bus)

    def step(self, now_s: float, heard: list[Frame]) -> list[Frame]:
        self._bus.frames += heard
        for scan in self._source.poll(now_s):
            uids = [uid for module in scan.table for uid in module.uids]
            self.taxels = dict(zip(uids, scan.counts, strict=True))
        said, self._bus.sent = self._bus.sent, []
        return [frame._replace(t=0.0) for frame in said]


@pytest.mark.parametrize("name", NAMES)
def test_the_source_asks_what_each_conversation_has_nothing_else_and_reads_the_scan(
    name: str,
) -> None:
    conversation = load(name)
    period_ms = conversation.host["period_ms"]
    config = SourceConfig(kind="can", channel="x", period_ms=period_ms)
    hold_host(conversation, DaemonSource(config))


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


@pytest.fixture
def ours(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[KernelSocket, socket.socket]]:
    """What is opened, and its other end."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    far.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    made = KernelSocket(fileno=near.detach())
    monkeypatch.setattr(socketcan, "opened", lambda _: made)
    yield made, far
    far.close()
    made.close()


@pytest.fixture
def bus(ours: tuple[KernelSocket, socket.socket]) -> socket.socket:
    return ours[1]


@pytest.fixture
def device(bus: socket.socket) -> Iterator[SocketCanDevice]:  # noqa: ARG001
    made = open_device(CONFIG)
    assert isinstance(made, SocketCanDevice)
    yield made
    made.close()


def packed(frame: Frame, flags: int = 0) -> bytes:
    number = frame.can_id | 0x8000_0000 * frame.extended | flags
    return FRAME.pack(number, len(frame.data), frame.data)


def error(classes: int, data: str = "") -> bytes:
    return FRAME.pack(0x2000_0000 | classes, 8, bytes.fromhex(data).ljust(8, b"\0"))


def counted(source: LiveSource) -> dict[str, int]:
    return {str(kind): n for kind, n in source.bus.counts.items() if n}


def counts(k: int) -> list[int]:
    return [1000 * k + i + 1 for i in range(CHANNELS)]


def scan_frames(k: int, t: float = 0.0) -> list[Frame]:
    return frames_of(VirtualIhb(MODULES).sensor_data(counts(k)), t=t)


def test_frames_come_out_as_they_are_with_the_time_of_each(
    device: SocketCanDevice, bus: socket.socket
) -> None:
    sent = [
        Frame(0.0, 0x000, b""),
        Frame(0.0, 0x7FF, b"\x01"),
        Frame(0.0, 0x1FFF_FFFF, b"12345678", extended=True),
        Frame(0.0, 0x12, b"\x00\x00", extended=True),
    ]
    began = time.time()
    for frame in sent:
        bus.send(packed(frame))
        bus.send(packed(frame, 0x4000_0000))  # a remote frame
        time.sleep(0.002)
    read = device.read()
    assert [frame._replace(t=0.0) for frame in read] == sent
    assert (device.noticed.foreign, device.noticed.bus.total()) == (4, 0)
    times = [began, *(frame.t for frame in read), time.time()]
    assert times == sorted(times)
    gaps = [b - a for a, b in itertools.pairwise(frame.t for frame in read)]
    assert min(gaps) >= 0.001, "as the kernel took them"


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
    bus: socket.socket,
    classes: int,
    data: str,
    told: list[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    source = LiveSource(CONFIG, {0: SKIN}, open_device)
    for now_s in (0.0, 1.0):
        bus.send(error(classes, data))
        source.poll(now_s)
    assert counted(source) == dict.fromkeys(told, 2)
    assert source.decoder.stats()["dropped"]["foreign"] == 0  # type: ignore[index]
    faults = [kind for kind in told if kind not in bus_faults.NORMAL]
    lines = [f"source.channel: {BusFault(kind).line}" for kind in faults[:1]]
    assert caplog.messages == lines, "the gravest, once"
    assert source.waits_for == "".join(lines)
    words = bus_faults.counted(counted(source))
    assert all(f"{kind} 2 ({BusFault(kind).line})" in words for kind in told)
    source.close()


def test_every_fault_of_a_bus_names_its_cure() -> None:
    for fault in BusFault:
        has_cure = any(word in fault.line for word in ("check", "see that", "close other"))
        assert has_cure or fault in bus_faults.NORMAL


def test_a_bus_that_is_off_is_waited_for_until_it_works_and_an_event_passes_by_itself(
    bus: socket.socket, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    source = LiveSource(CONFIG, {0: SKIN}, open_device)

    def said(now_s: float) -> list[str]:
        caplog.clear()
        source.poll(now_s)
        return [record.getMessage().partition("source.channel: ")[0] for record in caplog.records]

    bus.send(error(0x040))
    assert said(0.0) == [""]
    assert said(1000.0) == [], "it lasts"
    assert "bus-off" in source.waits_for
    bus.send(error(0x100))
    assert said(1001.0) == []
    assert said(1001.0 + PASSED_S) == ["no longer: "]
    assert source.waits_for == ""
    bus.send(error(0x004, "0020"))
    assert said(2000.0) == [""]
    bus.send(packed(Frame(0.0, 0x101, b"a")))
    source.poll(2001.0)
    assert source.waits_for == "", "what comes is not waited for"
    assert said(2001.0 + PASSED_S) == ["no longer: "]
    bus.send(error(0x020))
    assert said(3000.0) == [""]
    assert said(3000.0 + PASSED_S) == ["no longer: "]
    source.close()


def test_frames_that_the_kernel_dropped_are_counted_and_said(
    ours: tuple[KernelSocket, socket.socket], caplog: pytest.LogCaptureFixture
) -> None:
    source = LiveSource(CONFIG, {0: SKIN}, open_device)
    for dropped in (0, 5, 5, 12):
        ours[0].dropped = dropped
        ours[1].send(packed(Frame(0.0, 0x101, b"a")))
        source.poll(float(dropped))
    assert counted(source) == {"unread": 12}
    (line,) = caplog.messages
    assert "the kernel dropped frames, not read in time" in line
    source.close()


def test_all_that_has_come_is_read_in_its_order_and_a_lost_interface_is_told_after_it(
    device: SocketCanDevice, ours: tuple[KernelSocket, socket.socket]
) -> None:
    near, bus = ours
    bus.setblocking(False)
    sent, read = 0, list[Frame]()
    while sent < 200:
        with contextlib.suppress(BlockingIOError):  # the kernel holds some tens of datagrams
            while sent < 200:
                bus.send(packed(Frame(0.0, 0x101, bytes([sent]))))
                sent += 1
        near.fault = errno.ENETDOWN if sent == 200 else 0
        read += device.read()
    assert [frame.data[0] for frame in read] == [*range(200)]
    with pytest.raises(LostError) as lost:
        device.read()
    assert "down" in str(lost.value.__cause__)


def test_requests_go_out_and_wait_while_the_kernel_takes_none(
    device: SocketCanDevice, bus: socket.socket
) -> None:
    for command in (Command.DECLARE, LEAVE_BOOTLOADER):
        sent = device.send(BROADCAST, command, b"")
        assert bus.recv(64) == packed(sent)
    with pytest.raises(BlockingIOError):
        any(device.send(BROADCAST, Command.DECLARE, b"") is None for _ in range(100_000))


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
    frames = [frame for k in range(3) for frame in scan_frames(k, 1.0 + 0.05 * k)]
    size, device = len(frames) // 3, GivenDevice()
    with Recorder(tmp_path / "session", moves=False) as recorder:
        source = LiveSource(CONFIG, {0: SKIN}, lambda _: device, recorder)
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
    assert [list(scan.counts) for scan in scans] == [counts(k) for k in range(3)]
    assert items_of(tmp_path / "session") == frames
