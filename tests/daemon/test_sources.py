"""Sources on real pseudo-terminals and python-can's virtual bus."""

import os
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from taxeld.config.tables import SourceConfig
from taxeld.source.can_device import CanDevice
from taxeld.source.device import LostError
from taxeld.source.recorder import Recorder
from taxeld.source.sources import LiveSource, Source, least_period_ms, open_source
from taxeld_protocol import cyskin, serial_link
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.serial_link import SerialReader
from taxeld_protocol.virtual_ihb import Answer, HubLink, Phase, VirtualIhb
from tests.rig.clocks import until
from tests.rig.given_device import GivenDevice
from tests.rig.sessions import items_of
from tests.rig.skins import CHANNELS, LISTED, MODULES, SKIN
from tests.rig.virtual_hub import VirtualHub

DEADLINE_S = 20.0


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[VirtualHub]:
    with VirtualHub(tmp_path / "adapter", MODULES) as made:
        yield made


def scans_until(source: Source, serve: Callable[[int], None], wanted: int) -> list[Scan]:
    """Poll, and let the hub work, until so many scans have come."""
    scans: list[Scan] = []

    def poll() -> None:
        serve(len(scans))
        scans.extend(source.poll(time.monotonic()))

    until(lambda: len(scans) >= wanted, poll)
    return scans


def message(frame: Frame) -> can.Message:
    return can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)


def counts(k: int) -> list[int]:
    return [1000 * k + i + 1 for i in range(CHANNELS)]


def test_damaged_slcan_lines_cost_only_themselves(hub: VirtualHub) -> None:
    settings = SourceConfig(
        kind="can", interface="slcan", channel=hub.device, listen_only=True, modules=LISTED
    )
    source = open_source(settings, SKIN)
    noise = [b"t1ZZ8junk\r", b"\xff\xfe\r", b"t\r", b"T123\r", b"\x07", b"tttt\r"]

    def serve(k: int) -> None:
        hub.answer(time.time())
        os.write(hub.port.fileno(), noise[k % len(noise)])
        source.poll(time.monotonic())
        hub.scan(counts(k))

    serve(0)
    scans = scans_until(source, serve, len(noise) + 2)
    good = [counts(k) for k in range(20)]
    assert len(scans) >= len(noise) + 2
    assert all(list(scan.counts) in good for scan in scans)
    source.close()


def test_the_native_serial_link_brings_the_skin_up() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    source = open_source(SourceConfig(kind="serial", channel=os.ttyname(slave)), SKIN)
    hub, requests = VirtualIhb(MODULES, phase=Phase.MODULES), SerialReader()

    def serve(k: int) -> None:
        answers: list[Answer] = []
        with suppress(BlockingIOError):
            heard = requests.feed(os.read(master, 4096), 0.0)
            answers = [a for packet in heard for a in hub.answer(packet)]
        if hub.due(time.monotonic()):
            answers += hub.sensor_data(counts(k))
        for command, payload in answers:
            line = serial_link.encode(command, payload, ihb=hub.short_id)
            for at in range(0, len(line), 7):
                os.write(master, line[at : at + 7])

    scans = scans_until(source, serve, 4)
    assert [list(scan.counts) for scan in scans] == [counts(k) for k in range(4)]
    source.close()
    os.close(master)
    os.close(slave)


def test_a_cold_hub_on_a_can_bus_is_led_out_of_its_bootloader_by_a_frame_of_29_bits(
    tmp_path: Path,
) -> None:
    """And the recording has it as candump would."""
    settings = SourceConfig(kind="can", interface="virtual", channel="cold")
    hub, link = VirtualIhb(MODULES), HubLink()
    with (
        can.Bus(interface="virtual", channel="cold") as bus,
        Recorder(tmp_path / "session", moves=False) as recorder,
    ):
        source = open_source(settings, SKIN, recorder)

        def serve(k: int) -> None:
            answers: list[Answer] = []
            while m := bus.recv(0.0):
                heard = Frame(0.0, m.arbitration_id, bytes(m.data), m.is_extended_id)
                request = link.feed(heard)
                answers += [] if request is None else hub.answer(request)
            if hub.due(time.monotonic()):
                answers += hub.sensor_data(counts(k))
            for command, payload in answers:
                for frame in cyskin.to_frames(command, payload, ihb=hub.short_id):
                    bus.send(message(frame))

        assert hub.phase == Phase.BOOTLOADER
        scans = scans_until(source, serve, 2)
        assert [list(scan.counts) for scan in scans[:2]] == [counts(0), counts(1)]
        source.close()
    log = (tmp_path / "session" / "frames.log").read_text(encoding="ascii").splitlines()
    assert log[0].endswith(" can0 17FFFFFF#013B00004F6D17")


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


def test_a_virtual_bus_with_foreign_frames_is_read_through() -> None:
    settings = SourceConfig(
        kind="can", interface="virtual", channel="foreign", listen_only=True, modules=LISTED
    )
    source = open_source(settings, SKIN)
    hub = VirtualIhb(MODULES)
    with can.Bus(interface="virtual", channel="foreign") as bus:
        bus.send(can.Message(arbitration_id=0x18DAF110, is_extended_id=True, data=b"x"))
        bus.send(can.Message(arbitration_id=0x101, is_remote_frame=True, is_extended_id=False))
        for command, payload in hub.sensor_data(counts(3)):
            for frame in cyskin.to_frames(command, payload, ihb=1):
                bus.send(message(frame))
        (scan,) = source.poll(0.0)
    assert list(scan.counts) == counts(3)
    assert source.decoder.stats()["unknown"] == 2
    source.close()


@pytest.mark.parametrize(("behind_s", "kept"), [(0.02, True), (7200.0, True), (1e8, False)])
def test_stamps_of_an_adapters_own_clock_are_replaced_by_the_arrivals(
    monkeypatch: pytest.MonkeyPatch, behind_s: float, kept: bool
) -> None:
    """Some count from their start; the kernel's are believed, however old."""
    config = SourceConfig(kind="can", interface="virtual", channel="stamps")
    stamp = time.time() - behind_s
    waiting = [can.Message(timestamp=stamp, arbitration_id=0x101, data=b"\x43")]
    heard = lambda *_: waiting.pop() if waiting else None  # noqa: E731
    monkeypatch.setattr(can.interfaces.virtual.VirtualBus, "recv", heard)
    device = CanDevice(config)
    (frame,) = device.read()
    assert (frame.t == stamp) == kept
    assert kept or time.time() - frame.t < DEADLINE_S
    device.close()


def test_a_bus_without_a_descriptor_is_polled_and_one_that_fails_is_lost_after_its_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    say: list[object] = [
        can.Message(arbitration_id=0x101, data=b"\x43", is_extended_id=False),
        ValueError("damaged"),
        can.Message(arbitration_id=0x102, data=b"", is_extended_id=False),
        can.CanOperationError("gone"),
    ]

    def next_one(*_: object) -> object:
        said = say.pop(0) if say else None
        if isinstance(said, Exception):
            raise said
        return said

    monkeypatch.setattr(can.interfaces.virtual.VirtualBus, "recv", next_one)
    device = CanDevice(SourceConfig(kind="can", interface="virtual", channel="x"))
    assert device.fileno() < 0
    assert [[frame.can_id for frame in device.read()] for _ in range(2)] == [[0x101], [0x102]]
    with pytest.raises(LostError):
        device.read()
    device.close()


def test_what_was_gathered_is_heard_in_its_order_and_nothing_is_lost_with_the_device(
    tmp_path: Path,
) -> None:
    settings = SourceConfig(kind="can", listen_only=True, modules=LISTED)
    frames = [
        frame
        for k in range(3)
        for command, payload in VirtualIhb(MODULES).sensor_data(counts(k))
        for frame in cyskin.to_frames(command, payload, ihb=1, t=1.0 + 0.05 * k)
    ]
    cut = len(frames) // 2
    device = GivenDevice()
    with Recorder(tmp_path / "session", moves=False) as recorder:
        source = LiveSource(settings, {0: SKIN}, lambda _: device, recorder)
        held = []
        for part in (frames[:5], [], frames[5:cut]):
            device.frames = part
            held.append(source.gather())
        assert held == [5, 5, cut]
        scans = source.poll(0.1)
        device.frames = frames[cut:]
        source.gather()
        device.is_lost = True
        assert source.gather() == len(frames) - cut
        scans += source.poll(0.2)
        assert source.counters.lost == 0
        assert source.device is device
        source.poll(0.3)
        assert source.counters.lost == 1
        assert source.device is None
        source.close()
    assert [list(scan.counts) for scan in scans] == [counts(k) for k in range(3)]
    assert items_of(tmp_path / "session") == frames
