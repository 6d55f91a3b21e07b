"""Devices that take nothing, are not there, or belong to somebody else: the loop goes on."""

import contextlib
import errno
import fcntl
import logging
import os
import select
import termios
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from can.interfaces.virtual import VirtualBus

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.lines import SerialLine
from taxeld.source.recorder import Recorder
from taxeld.source.sources import LiveSource, open_device, open_source
from taxeld_protocol.cyskin import Command
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.serial_link import SerialReader
from tests.rig.clocks import until
from tests.rig.processes import python
from tests.rig.sessions import items_of
from tests.rig.skins import CHANNELS, MODULES, SKIN
from tests.rig.virtual_hub import VirtualHub

TICK_S = 0.01


class FarEnd:
    """The other end of a pseudo-terminal, which reads when it is told to."""

    def __init__(self) -> None:
        self._fd, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._fd, False)
        os.set_blocking(slave, False)
        self.device, self._slave = os.ttyname(slave), slave

    def fill(self) -> None:
        """What the host wrote before takes all the room there is, also what the kernel makes."""
        for _ in range(10):
            with contextlib.suppress(BlockingIOError):
                while True:
                    os.write(self._slave, bytes(4096))
            time.sleep(0.01)

    def read(self) -> bytes:
        data = b""
        with contextlib.suppress(BlockingIOError):
            while True:
                data += os.read(self._fd, 65536)
        return data

    def close(self) -> None:
        os.close(self._fd)
        os.close(self._slave)


@pytest.fixture
def far_end() -> Iterator[FarEnd]:
    made = FarEnd()
    yield made
    made.close()


@pytest.fixture
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From the call on, whoever waits for a descriptor fails the test."""
    real = select.select

    def spy(r: Any, w: Any, x: Any, timeout: float | None = None) -> Any:
        assert timeout == 0, f"waited for {timeout} s"
        return real(r, w, x, timeout)

    def drain(_: int) -> None:
        raise AssertionError("waited for a line to be empty")

    def start() -> None:
        monkeypatch.setattr(select, "select", spy)
        monkeypatch.setattr(termios, "tcdrain", drain)

    return start


def live(config: SourceConfig, recorder: Recorder | None = None) -> LiveSource:
    source = open_source(config, SKIN, recorder, wait=True)
    assert isinstance(source, LiveSource)
    return source


@pytest.mark.parametrize("kind", ["serial", "can"])
def test_a_line_whose_far_end_stops_reading_makes_no_tick_wait(
    far_end: FarEnd, no_waiting: Callable[[], None], kind: str
) -> None:
    config = SourceConfig(kind=kind, interface="slcan", channel=far_end.device)
    source = open_source(config, SKIN)
    far_end.fill()
    no_waiting()
    for tick in range(2000):
        source.poll(tick * TICK_S)
    assert 30 <= source.counters.unsent <= 3 * 2000 * TICK_S / 0.5
    assert source.counters.lost == 0
    source.close()


def test_requests_go_out_again_and_whole_once_the_far_end_reads(far_end: FarEnd) -> None:
    source = open_source(SourceConfig(kind="serial", channel=far_end.device), SKIN)
    source.poll(0.0)
    far_end.read()
    far_end.fill()
    for tick in range(100, 1000):
        source.poll(tick * TICK_S)
    reader = SerialReader()
    reader.feed(far_end.read() + b"\0", 0.0)
    damaged = reader.counters.crc_errors + reader.counters.length_errors
    packets = []
    for tick in range(1000, 1200):
        source.poll(tick * TICK_S)
        packets += reader.feed(far_end.read(), 0.0)
    assert packets[0].command == Command.DISCOVERY_PING
    assert reader.counters.crc_errors + reader.counters.length_errors == damaged
    source.close()


def test_a_request_that_has_begun_is_finished_before_the_next(
    far_end: FarEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    room, taken = 3, b""

    def write(_: SerialLine, data: bytes) -> int:
        nonlocal room, taken
        part = data[:room]
        room, taken = room - len(part), taken + part
        return len(part)

    monkeypatch.setattr(SerialLine, "_write", write)
    device = open_device(SourceConfig(kind="serial", channel=far_end.device))
    device.send(1, Command.DECLARE, b"")
    with pytest.raises(BlockingIOError):
        device.send(2, Command.DECLARE, b"")
    room = 100
    device.send(3, Command.DECLARE, b"")
    packets = SerialReader().feed(taken, 0.0)
    assert [packet.ihb for packet in packets] == [1, 3]
    device.close()


def test_a_can_bus_that_is_full_gets_its_requests_when_it_has_room_and_only_those_are_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = True
    real = VirtualBus.send

    def send(self: Any, message: can.Message, timeout: float | None = None) -> None:
        if full:
            raise can.CanOperationError("Transmit buffer full")
        real(self, message, timeout)

    monkeypatch.setattr(VirtualBus, "send", send)
    with (
        Recorder(tmp_path, moves=False) as recorder,
        can.Bus(interface="virtual", channel="full") as bus,
    ):
        source = live(SourceConfig(kind="can", interface="virtual", channel="full"), recorder)
        source.poll(0.0)
        source.poll(0.1)
        assert (recorder.counters.frames, source.counters.unsent) == (0, 0)
        full = False
        source.poll(0.2)
        source.poll(0.25)
        assert bus.recv(0.0) is not None
        assert bus.recv(0.0) is None, "the pause after a request begins when it has left"
        source.poll(0.4)
        source.close()
        heard = 1
        while bus.recv(0.0) is not None:
            heard += 1
    assert heard == recorder.counters.frames >= 3


def test_a_device_that_is_not_there_yet_is_waited_for_with_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    source = live(SourceConfig(kind="serial", channel=str(tmp_path / "skin")))
    for tick in range(500):
        assert source.poll(tick * TICK_S) == []
    assert source.counters.unopened >= 4
    assert "it is not there" in source.waits_for
    (record,) = caplog.records
    assert record.getMessage() == f"{source.waits_for}; waiting for it"
    hub = VirtualHub(tmp_path / "skin", MODULES, native=True)

    def poll() -> None:
        hub.serve(time.monotonic(), lambda _: [7] * CHANNELS)
        source.poll(time.monotonic())

    until(lambda: source.decoder.counters.scans >= 2, poll)
    assert source.waits_for == ""
    assert sum("is open" in message for message in caplog.messages) == 1
    source.close()
    hub.unplug()


@pytest.mark.parametrize(("kind", "interface"), [("serial", "socketcan"), ("can", "slcan")])
def test_a_line_that_another_process_has_locked_is_waited_for(
    far_end: FarEnd, kind: str, interface: str
) -> None:
    config = SourceConfig(kind=kind, interface=interface, channel=far_end.device)
    other = os.open(far_end.device, os.O_RDWR | os.O_NOCTTY)
    fcntl.flock(other, fcntl.LOCK_EX)
    source = live(config)
    source.poll(1.0)
    assert "another process has it open" in source.waits_for
    os.close(other)
    source.poll(10.0)
    assert source.waits_for == ""
    source.close()


def refuse(*_: object, **__: object) -> int:
    raise PermissionError(errno.EACCES, "Permission denied")


def test_what_only_a_person_can_mend_is_not_waited_for(
    tmp_path: Path, far_end: FarEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file"
    file.touch()
    for config, line in (
        (SourceConfig(kind="serial", channel=str(file)), "it is no serial line"),
        (SourceConfig(kind="serial", channel=str(tmp_path)), "it is a directory"),
        (SourceConfig(kind="can", interface="no_such", channel="x"), "source.interface: "),
        (SourceConfig(kind="can", interface="slcan", channel="x@fast"), "a line speed"),
    ):
        with pytest.raises(SetupError, match=line):
            live(config)
    monkeypatch.setattr("serial.serialposix.os.open", refuse)
    with pytest.raises(SetupError, match="permission denied; is this user in the group"):
        live(SourceConfig(kind="serial", channel=far_end.device))


def test_a_line_that_goes_while_it_is_being_opened_is_waited_for(
    far_end: FarEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its driver's complaint is then no OSError."""

    def gone(*_: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr("serial.serialposix.termios.tcsetattr", gone)
    source = live(SourceConfig(kind="serial", channel=far_end.device))
    assert "Input/output error" in source.waits_for
    source.close()


def test_who_hears_no_bus_of_python_cans_does_not_load_it() -> None:
    """It is a tenth of the time to start and of the memory."""
    code = "import sys, taxeld.service.loop; sys.exit('can' in sys.modules)"
    python(code)


@pytest.mark.parametrize("interface", ["slcan", "native"])
def test_what_waited_on_a_line_while_the_loop_was_stopped_is_dropped_and_counted(
    tmp_path: Path, interface: str
) -> None:
    """Nothing tells when it came, and the robot may have moved meanwhile."""
    stopped_s = 1.0
    with (
        Recorder(tmp_path / "session", moves=False) as recorder,
        VirtualHub(tmp_path / "skin", MODULES, native=interface == "native") as hub,
    ):
        source = open_source(SourceConfig(**hub.source), SKIN, recorder)  # type: ignore[arg-type]
        now, scans, held = 0.0, list[Scan](), list[Scan]()

        def turn(into: list[Scan], *, polls: bool = True) -> None:
            nonlocal now
            now = round(now + 0.01, 6)
            hub.serve(now, lambda k: [k + 1] * CHANNELS)
            if polls:
                into.extend(source.poll(now))

        until(lambda: len(scans) >= 3, lambda: turn(scans))
        before = hub.scans
        for _ in range(round(stopped_s / 0.01)):
            turn(scans, polls=False)
        missed = hub.scans - before
        assert missed >= 15
        until(lambda: len(held) >= 3, lambda: turn(held))
        assert [scan.counts[0] for scan in held] == [*range(hub.scans - 2, hub.scans + 1)]
        assert source.counters.late == missed
        source.close()
    decoded = Decoder().take(items_of(tmp_path / "session"))  # type: ignore[arg-type]
    counts = [scan.counts[0] for _, ended in decoded for scan in ended]
    assert counts == [scan.counts[0] for scan in [*scans, *held]], "it is not recorded"
