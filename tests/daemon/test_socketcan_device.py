"""Frames of the kernel's CAN interfaces. Datagrams of a Unix socket stand in for them: the kernel
stamps and delivers both in the same way."""

import contextlib
import errno
import itertools
import os
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest

from taxeld.config.tables import SourceConfig
from taxeld.source import dialects, socketcan_device
from taxeld.source.device import AwayError, LostError
from taxeld.source.devices import open_device
from taxeld.source.socketcan_device import SocketCanDevice
from taxeld.source.sources import LiveSource
from taxeld_protocol import cyskin
from taxeld_protocol.frames import Frame
from taxeld_protocol.virtual_ihb import VirtualIhb
from tests.daemon.test_sources import counts
from tests.rig.skins import LISTED, MODULES, SKIN

CONFIG = SourceConfig(kind="can", channel="can0", listen_only=True, modules=LISTED)
FRAME = struct.Struct("=IB3x8s")


class Ours(socket.socket):
    """Tells a fault once, after all that came before it, as the kernel does."""

    fault = 0

    def recvmsg(self, *sizes: int) -> Any:
        try:
            return super().recvmsg(*sizes)
        except BlockingIOError:
            number, self.fault = self.fault, 0
            if number:
                raise OSError(number, os.strerror(number)) from None
            raise


@pytest.fixture
def ours(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Ours, socket.socket]]:
    """What is opened, and its other end."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    far.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    made = Ours(fileno=near.detach())
    monkeypatch.setattr(socketcan_device, "opened", lambda _: made)
    yield made, far
    far.close()
    made.close()


@pytest.fixture
def bus(ours: tuple[Ours, socket.socket]) -> socket.socket:
    return ours[1]


@pytest.fixture
def device(bus: socket.socket) -> Iterator[SocketCanDevice]:  # noqa: ARG001
    made = open_device(CONFIG, lambda *_: [])
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


def test_error_frames_and_remote_frames_are_counted_and_no_more(
    device: SocketCanDevice, bus: socket.socket
) -> None:
    frame = Frame(0.0, 0x101, b"abc")
    for flags in (0x2000_0000, 0x4000_0000, 0):
        bus.send(packed(frame, flags))
    assert [read._replace(t=0.0) for read in device.read()] == [frame]
    assert device.noticed.foreign == 2


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
    for frame in (Frame(0.0, 0x5FF, b"\x38\x02"), Frame(0.0, 0x17FF_FFFF, b"\x01", extended=True)):
        device.put(frame)
        assert bus.recv(64) == packed(frame)
    with pytest.raises(BlockingIOError):
        put_many(device, frame)


def put_many(device: SocketCanDevice, frame: Frame) -> None:
    for _ in range(100_000):
        device.put(frame)


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
    source = LiveSource(CONFIG, dialects.live(CONFIG, SKIN), open_device, None)
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


@pytest.mark.parametrize("channel", ["can77", "lo", "a name that is far too long for an interface"])
def test_an_interface_that_is_no_can_bus_is_one_line(channel: str) -> None:
    with pytest.raises(AwayError, match=rf"^source\.channel: .*{channel}.*$"):
        open_device(SourceConfig(kind="can", channel=channel), lambda *_: [])
