"""Frames of the kernel's CAN interfaces. Datagrams of a Unix socket stand in for them: the kernel
stamps and delivers both in the same way."""

import array
import contextlib
import errno
import itertools
import logging
import os
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest

from taxeld.config.tables import SourceConfig
from taxeld.source import bus_faults, socketcan
from taxeld.source.bus_faults import PASSED_S, BusFault
from taxeld.source.device import AwayError, LostError
from taxeld.source.socketcan import SocketCanDevice
from taxeld.source.sources import LiveSource, open_device
from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command
from taxeld_protocol.frames import Frame
from taxeld_protocol.virtual_ihb import VirtualIhb
from tests.daemon.test_sources import counts
from tests.rig.skins import LISTED, MODULES, SKIN

CONFIG = SourceConfig(kind="can", channel="can0", listen_only=True, modules=LISTED)
FRAME = struct.Struct("=IB3x8s")


class Ours(socket.socket):
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
def ours(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Ours, socket.socket]]:
    """What is opened, and its other end."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    far.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    made = Ours(fileno=near.detach())
    monkeypatch.setattr(socketcan, "opened", lambda _: made)
    yield made, far
    far.close()
    made.close()


@pytest.fixture
def bus(ours: tuple[Ours, socket.socket]) -> socket.socket:
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
        time.sleep(0.002)
    read = device.read()
    assert [frame._replace(t=0.0) for frame in read] == sent
    times = [began, *(frame.t for frame in read), time.time()]
    assert times == sorted(times)
    gaps = [b - a for a, b in itertools.pairwise(frame.t for frame in read)]
    assert min(gaps) >= 0.001, "as the kernel took them"
    assert device.read() == []


def test_remote_frames_are_counted_and_no_more(device: SocketCanDevice, bus: socket.socket) -> None:
    frame = Frame(0.0, 0x101, b"abc")
    for flags in (0x4000_0000, 0):
        bus.send(packed(frame, flags))
    assert [read._replace(t=0.0) for read in device.read()] == [frame]
    assert (device.noticed.foreign, device.noticed.bus.total()) == (1, 0)


# name, classes in the id and bytes of the data (linux/can/error.h), and all that they tell
ERROR_FRAMES: list[tuple[str, int, str, list[str]]] = [
    ("transmit timeout", 0x001, "", ["timeout"]),
    ("lost arbitration in bit 3", 0x002, "03", ["arbitration"]),
    ("controller, unspecified", 0x004, "", ["warning"]),
    ("receive buffer overflow", 0x004, "0001", ["overflow"]),
    ("transmit buffer overflow", 0x004, "0002", ["overflow"]),
    ("warning level of received", 0x004, "0004", ["warning"]),
    ("warning level of sent", 0x004, "0008", ["warning"]),
    ("error-passive in receiving", 0x004, "0010", ["passive"]),
    ("error-passive in sending, with counters", 0x204, "0020000000008000", ["passive"]),
    ("error-active again", 0x004, "0040", ["active"]),
    ("protocol, unspecified", 0x008, "", ["error"]),
    *((f"protocol, bit {n}", 0x008, f"0000{1 << n:02X}", ["error"]) for n in range(8)),
    ("no acknowledgement, in its slot", 0x088, "00000019", ["no_ack"]),
    ("no acknowledgement, its delimiter", 0x008, "0000001B", ["no_ack"]),
    ("a stuff error in the data", 0x088, "0000040A", ["error"]),
    ("transceiver, CAN-H without wire", 0x010, "0000000004", ["transceiver"]),
    ("transceiver, CAN-L shorted to CAN-H", 0x010, "0000000080", ["transceiver"]),
    ("no acknowledgement", 0x020, "", ["no_ack"]),
    ("bus-off", 0x040, "", ["off"]),
    ("bus error", 0x080, "", ["error"]),
    ("restarted", 0x100, "", ["restarted"]),
    ("counters alone", 0x200, "0000000000000102", []),
    ("a class of the future", 0x400, "", ["error"]),
    ("no class, as other interfaces have it", 0x000, "", ["error"]),
    ("several at once", 0x0E4, "0030", ["off", "no_ack", "passive", "error"]),
]


@pytest.mark.parametrize(("name", "classes", "data", "told"), ERROR_FRAMES, ids=str)
def test_each_class_of_error_frames_is_counted_by_its_kind_and_said_with_its_cure(
    bus: socket.socket,
    name: str,  # noqa: ARG001
    classes: int,
    data: str,
    told: list[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    source = LiveSource(CONFIG, {0: SKIN}, open_device)
    for now_s in (0.0, 1.0):
        bus.send(FRAME.pack(0x2000_0000 | classes, 8, bytes.fromhex(data).ljust(8, b"\0")))
        source.poll(now_s)
    assert {kind: n for kind, n in source.bus.counts.items() if n} == dict.fromkeys(told, 2)
    assert source.decoder.stats()["dropped"]["foreign"] == 0  # type: ignore[index]
    faults = [kind for kind in told if kind not in bus_faults.NORMAL]
    lines = [f"source.channel: {BusFault(kind).line}" for kind in faults[:1]]
    assert [record.getMessage() for record in caplog.records] == lines, "the gravest, once"
    assert source.waits_for == "".join(lines)
    words = bus_faults.counted({str(kind): n for kind, n in source.bus.counts.items()})
    assert all(f"{kind} 2 ({BusFault(kind).line})" in words for kind in told)
    source.close()


def test_every_fault_of_a_bus_names_its_cure() -> None:
    for fault in BusFault:
        has_cure = any(word in fault.line for word in ("check", "see that", "close other"))
        assert has_cure or fault in bus_faults.NORMAL


def error(classes: int, *data: int) -> bytes:
    return FRAME.pack(0x2000_0000 | classes, 8, bytes(data).ljust(8, b"\0"))


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
    bus.send(error(0x004, 0, 0x20))
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
    ours: tuple[Ours, socket.socket], caplog: pytest.LogCaptureFixture
) -> None:
    source = LiveSource(CONFIG, {0: SKIN}, open_device)
    for dropped in (0, 5, 5, 12):
        ours[0].dropped = dropped
        ours[1].send(packed(Frame(0.0, 0x101, b"a")))
        source.poll(float(dropped))
    assert source.bus.counts[BusFault.UNREAD] == 12
    (line,) = caplog.messages
    assert "the kernel dropped frames, not read in time" in line
    source.close()


def virtual(channel: str) -> tuple[LiveSource, can.BusABC]:
    config = SourceConfig(
        kind="can", interface="virtual", channel=channel, listen_only=True, modules=LISTED
    )
    bus = can.Bus(interface="virtual", channel=channel)
    return LiveSource(config, {0: SKIN}, open_device), bus


@pytest.mark.parametrize(("name", "classes", "data", "told"), ERROR_FRAMES, ids=str)
def test_error_frames_of_python_cans_interfaces_tell_the_same(
    name: str, classes: int, data: str, told: list[str]
) -> None:
    source, bus = virtual(name)
    message = can.Message(
        arbitration_id=classes, data=bytes.fromhex(data), is_error_frame=True, is_extended_id=True
    )
    bus.send(message)
    source.poll(0.0)
    assert {kind: n for kind, n in source.bus.counts.items() if n} == dict.fromkeys(told, 1)
    source.close()
    bus.shutdown()


def test_an_error_frame_of_another_form_is_a_damaged_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("taxeld.source.can_device.AS_THE_KERNEL", ())
    source, bus = virtual("vendor")
    bus.send(can.Message(arbitration_id=0x40, is_error_frame=True))
    source.poll(0.0)
    assert {kind: n for kind, n in source.bus.counts.items() if n} == {"error": 1}
    source.close()
    bus.shutdown()


class StateBus:
    """A vendor's interface, which tells the bus's state, or fails as that has it."""

    def __init__(self) -> None:
        self.state = can.BusState.ACTIVE
        self.fails = ""

    def recv(self, _: float) -> None:
        if self.fails:
            raise can.CanOperationError(self.fails)

    def shutdown(self) -> None:
        """Nothing is open."""


@pytest.mark.parametrize(
    ("happens", "kind"),
    [
        (lambda bus: setattr(bus, "state", can.BusState.ERROR), "off"),
        (lambda bus: setattr(bus, "state", can.BusState.PASSIVE), "passive"),
        (lambda bus: setattr(bus, "fails", "Controller is in BUSOFF state"), "off"),
        (lambda bus: setattr(bus, "fails", "The CAN controller is in bus-off state"), "off"),
        (lambda bus: setattr(bus, "fails", "Bus off status"), "off"),
    ],
)
def test_a_vendors_interface_tells_its_state_by_itself_or_by_an_exception(
    happens: Callable[[StateBus], None], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = StateBus()
    monkeypatch.setattr(can, "Bus", lambda **_: bus)
    config = SourceConfig(
        kind="can", interface="kvaser", channel="1", listen_only=True, modules=LISTED
    )
    source = LiveSource(config, {0: SKIN}, open_device)
    source.poll(0.0)
    assert sum(source.bus.counts.values()) == 0
    happens(bus)
    source.poll(2.0)
    bus.fails = ""
    source.poll(4.0)
    assert {kind: n for kind, n in source.bus.counts.items() if n} == {kind: 1}
    assert source.waits_for == f"source.channel: {BusFault(kind).line}"
    source.close()


def test_all_that_has_come_is_read_in_its_order(
    device: SocketCanDevice, bus: socket.socket
) -> None:
    bus.setblocking(False)
    sent, read = 0, list[Frame]()
    while sent < 200:
        with contextlib.suppress(BlockingIOError):  # the kernel holds some tens of datagrams
            while sent < 200:
                bus.send(packed(Frame(0.0, 0x101, bytes([sent]))))
                sent += 1
        read += device.read()
    assert [frame.data[0] for frame in read] == [*range(200)]


def test_requests_go_out_and_wait_while_the_kernel_takes_none(
    device: SocketCanDevice, bus: socket.socket
) -> None:
    for command in (Command.DECLARE, LEAVE_BOOTLOADER):
        sent = device.send(BROADCAST, command, b"")
        assert bus.recv(64) == packed(sent)
    with pytest.raises(BlockingIOError):
        send_many(device)


def send_many(device: SocketCanDevice) -> None:
    for _ in range(100_000):
        device.send(BROADCAST, Command.DECLARE, b"")


def test_an_interface_that_goes_down_is_lost_after_the_frames_that_came_before(
    device: SocketCanDevice, ours: tuple[Ours, socket.socket]
) -> None:
    ours[1].send(packed(Frame(0.0, 0x101, b"a")))
    ours[0].fault = errno.ENETDOWN
    assert [frame.data for frame in device.read()] == [b"a"]
    with pytest.raises(LostError) as lost:
        device.read()
    assert "down" in str(lost.value.__cause__)


def test_a_skin_is_heard_by_it(bus: socket.socket) -> None:
    source = LiveSource(CONFIG, {0: SKIN}, open_device)
    scans, began = [], time.time()
    for k in range(3):
        for command, payload in VirtualIhb(MODULES).sensor_data(counts(k)):
            for frame in cyskin.to_frames(command, payload, ihb=1):
                bus.send(packed(frame))
                source.gather()
        scans += source.poll(float(k))
        time.sleep(0.05)
    assert [list(scan.counts) for scan in scans] == [counts(k) for k in range(3)]
    assert all(began <= scan.t <= time.time() for scan in scans)
    source.close()


@pytest.mark.parametrize("channel", ["can77", "lo"])
def test_an_interface_that_is_no_can_bus_is_one_line(channel: str) -> None:
    with pytest.raises(AwayError, match=rf"^source\.channel: .*{channel}.*$"):
        open_device(SourceConfig(kind="can", channel=channel))
