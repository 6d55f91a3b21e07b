"""SLCAN adapters of several kinds on pseudo-terminals, behind the daemon's own source."""

import itertools
import logging
import math
import os
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import can
import pytest

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.bus_faults import BusFault
from taxeld.source.sources import LiveSource, open_device, open_source
from taxeld_hil.rig.adapters import KINDS, Adapter
from taxeld_hil.rig.ledger import WireUnit
from taxeld_hil.rig.ports import SlcanPort
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command, Packet
from taxeld_protocol.frames import Frame
from taxeld_protocol.slcan import BITRATES, split
from taxeld_protocol.virtual_ihb import Answer, Phase, VirtualIhb
from tests.rig.clocks import PATIENCE_S, until
from tests.rig.skins import CHANNELS, LISTED, MODULES, SKIN
from tests.rig.virtual_hub import VirtualHub

COUNTS = list(range(1, 1 + CHANNELS))

kinds = pytest.mark.parametrize("kind", KINDS)


def configured(device: str, **more: object) -> SourceConfig:
    return SourceConfig(kind="can", interface="slcan", channel=device, **more)  # type: ignore[arg-type]


class ServedSkin:
    """A source, and a hub behind an adapter, on a clock that stands while the test does not run."""

    def __init__(self, hub: VirtualHub, config: SourceConfig) -> None:
        source = open_source(config, SKIN)
        assert isinstance(source, LiveSource)
        assert isinstance(hub.port, SlcanPort)
        self.hub, self.source, self.port = hub, source, hub.port
        self.adapter = hub.port.adapter
        self.now_s = 0.0

    def until(self, true: Callable[[], bool]) -> float:
        """Serve the hub and poll until something is so; → by the clock, how long it took. Each scan
        must be right."""
        began_s = self.now_s
        until(true, self._poll)
        return self.now_s - began_s

    def _poll(self) -> None:
        self.hub.serve(self.now_s, lambda _: COUNTS)
        for scan in self.source.poll(self.now_s):
            assert list(scan.counts) == COUNTS
        self.now_s += 0.01

    def scans(self, more: int = 3) -> float:
        """Until so many more have come."""
        counters = self.source.decoder.counters
        wanted = counters.scans + more
        return self.until(lambda: counters.scans >= wanted)

    def close(self) -> None:
        """Until all that was written has come to the hub."""
        self.source.close()
        until(lambda: not self.adapter.is_open, lambda: self.hub.answer(self.now_s))


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Callable[..., ServedSkin]]:
    """A skin behind an adapter of a kind, and more keys of its source."""
    with ExitStack() as stack:

        def made(kind: str = "plain", at: str = "", **more: object) -> ServedSkin:
            link = tmp_path / f"adapter{len(list(tmp_path.iterdir()))}"
            hub = stack.enter_context(VirtualHub(link, MODULES, adapter=kind))
            skin = ServedSkin(hub, configured(hub.device + at, **more))
            stack.callback(skin.source.close)
            return skin

        yield made


Opened = Callable[..., ServedSkin]


@kinds
def test_the_skin_behind_each_kind_of_adapter_is_brought_up_and_left_stopped_and_closed(
    opened: Opened, kind: str
) -> None:
    skin = opened(kind)
    skin.scans()
    skin.close()
    assert not skin.hub.ihb.auto_sync
    assert not skin.adapter.is_open


@kinds
def test_listening_only_nothing_is_sent_to_the_bus_and_the_adapter_is_told_so(
    opened: Opened, kind: str
) -> None:
    skin = opened(kind, listen_only=True, modules=LISTED)
    skin.hub.ihb.phase, skin.hub.ihb.auto_sync = Phase.RUNNING, True  # something else started it
    skin.scans()
    assert skin.adapter.is_silent
    skin.close()
    assert skin.hub.requests == []


@kinds
def test_a_channel_that_another_process_closed_is_opened_again_and_said_once(
    opened: Opened, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    skin = opened(kind)
    source = skin.source
    skin.scans()
    caplog.clear()
    skin.port.close_channel()
    took_s = skin.until(lambda: bool(source.waits_for))
    named = f"source.channel: nothing has come from {skin.hub.device} for 1 s; "
    assert source.waits_for.startswith(named)
    assert took_s + skin.scans(1) <= 1.0 + 2.0
    assert source.waits_for == ""
    assert source.counters.lost == 0
    said = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert [level for level, _ in said] == ["WARNING", "INFO"]
    assert said[1][1] == f"no longer: {said[0][1]}"


class QuietHub(VirtualIhb):
    """It says nothing while its modules start."""

    wakes_s = -math.inf

    def answer(self, packet: Packet) -> list[Answer]:
        if packet.t < self.wakes_s:
            return []
        if packet.command == Command.MODULE_PROGRAM_END:
            self.wakes_s = packet.t + 1.6
        return super().answer(packet)


@pytest.mark.parametrize(
    "ihb",
    [
        lambda: VirtualIhb(MODULES, deaf_s=0.06),
        lambda: VirtualIhb(MODULES, deaf_s=0.06, says_busy=True),
        lambda: QuietHub(MODULES, modules_s=1.6),
    ],
    ids=["drops requests", "is busy", "is quiet"],
)
def test_a_hub_that_takes_its_time_is_started_and_its_channel_is_not_opened_again(
    opened: Opened, ihb: Callable[[], VirtualIhb], caplog: pytest.LogCaptureFixture
) -> None:
    skin = opened()
    skin.hub.ihb = ihb()
    assert skin.scans() < 6.0
    assert "its channel is opened again" not in caplog.text
    assert skin.source.counters.unsent == 0


@pytest.mark.parametrize(
    ("flags", "kind"),
    [
        (0x0B, "overflow"),
        (0x04, "warning"),
        (0x20, "passive"),
        (0x40, "arbitration"),
        (0x80, "error"),
    ],
)
def test_a_silent_adapter_is_asked_for_its_flags_and_they_are_said(
    opened: Opened, flags: int, kind: str
) -> None:
    skin = opened("lawicel", listen_only=True, modules=LISTED)
    skin.adapter.flags = flags
    skin.until(lambda: any(skin.source.bus.counts.values()))
    assert {fault: n for fault, n in skin.source.bus.counts.items() if n} == {kind: 1}
    assert (kind == "arbitration") != (BusFault(kind).line in skin.source.waits_for)


def test_a_line_that_another_process_set_otherwise_is_set_right_again(opened: Opened) -> None:
    """As a shell's `stty sane` does: it then echoes, and gives whole lines instead of bytes."""
    skin = opened("lawicel")
    skin.scans()
    slave = skin.port.slave
    form = termios.tcgetattr(slave)
    form[0] |= termios.ICRNL
    form[3] |= termios.ICANON | termios.ECHO
    termios.tcsetattr(slave, termios.TCSANOW, form)
    skin.port.close_channel()
    skin.until(lambda: bool(skin.source.waits_for))
    skin.scans()


def test_what_an_adapter_refuses_is_said_once_with_its_name(
    opened: Opened, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(BITRATES, 1_000_000, b"S9")  # Lawicel's knows no such
    skin = opened("lawicel")
    turns = itertools.count()
    skin.until(lambda: "refused S9" in caplog.text and next(turns) > 500)
    (line,) = [r.getMessage() for r in caplog.records if "refused S9" in r.getMessage()]
    assert line.startswith(
        f"source.channel: {skin.hub.device} refused S9 (it knows no such bit rate"
    )


def test_remote_and_fd_frames_are_passed_over_and_counted(opened: Opened) -> None:
    skin = opened("lawicel")
    skin.scans()
    strange = b"r1010\rR17FFFFFF8\rr10181A2B\rd1011AA\rB000001019" + b"00" * 12 + b"\r"
    os.write(skin.port.fileno(), strange)

    def foreign() -> int:
        return skin.source.decoder.stats()["dropped"]["foreign"]  # type: ignore[index]

    skin.until(lambda: foreign() >= 5)
    skin.scans()
    assert foreign() == 5


APART_S = 0.03  # time between the answers to lines that came together


class LateAdapter:
    """Lawicel's, on a pseudo-terminal, which answers each line later by the test's clock."""

    def __init__(self, late_s: float = 0.08, mute: bytes = b"") -> None:
        """`mute`: a line that it does not answer."""
        self._late_s, self._mute = late_s, mute
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)
        self.adapter = Adapter("lawicel")
        self._rest = b""
        self._answers: list[tuple[float, bytes]] = []

    def serve(self, now_s: float) -> None:
        with suppress(BlockingIOError):
            lines, self._rest = split(self._rest + os.read(self._master, 4096))
            answers = [(line, self.adapter.host(line)[0]) for line in lines]
            self._answers += [
                (now_s + self._late_s + k * APART_S, a)
                for k, (line, a) in enumerate(answers)
                if line != self._mute
            ]
        while self._answers and self._answers[0][0] <= now_s:
            os.write(self._master, self._answers.pop(0)[1])

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)


latencies = pytest.mark.parametrize("late_s", [0.0, 0.02, 0.08, 0.15])
mutes = pytest.mark.parametrize("mute", [b"", b"C"], ids=["answers C", "does not answer C"])


@pytest.mark.parametrize("listen_only", [False, True])
@latencies
@mutes
def test_an_adapter_that_answers_late_is_opened_and_none_of_its_answers_is_taken_for_a_refusal(
    listen_only: bool, late_s: float, mute: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(LateAdapter(late_s, mute)) as late:
        config = configured(late.device, listen_only=listen_only, modules=LISTED)
        with closing(open_source(config, SKIN)) as source:
            tick = itertools.count()

            def turn() -> None:
                now_s = 0.01 * next(tick)
                source.poll(now_s)
                late.serve(now_s)

            # the skin is silent, so that the channel is opened twice
            until(lambda: source.waits_for and late.adapter.on_bus, turn)
            for _ in range(50):
                turn()
            assert late.adapter.is_silent == listen_only
        assert "refused" not in caplog.text


@latencies
@mutes
def test_an_adapter_that_answers_late_and_refuses_the_bit_rate_is_named_with_that_alone(
    late_s: float, mute: bytes, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(BITRATES, 1_000_000, b"S9")
    with closing(LateAdapter(late_s, mute)) as late:
        with closing(open_source(configured(late.device), SKIN)) as source:
            for tick in range(150):
                source.poll(0.01 * tick)
                late.serve(0.01 * tick)
                time.sleep(0.001)
        said = [text for text in caplog.messages if "refused" in text]
        assert said[0].startswith(f"source.channel: {late.device} refused S9 (")
        # without a bit rate its channel does not open, and takes nothing
        assert all(text.split()[3][0] in "OtT" for text in said[1:]), said


LONG = Frame(0.0, 0x17FFFFFF, b"\x01\x3b\x00\x00\x4f\x6d\x17", extended=True)


@kinds
def test_a_frame_with_a_long_id_goes_to_the_bus_and_comes_from_it_as_such(
    tmp_path: Path, kind: str
) -> None:
    reached: list[Frame] = []
    with closing(SlcanPort(tmp_path / "adapter", reached.append, kind)) as port:
        device = open_device(configured(str(tmp_path / "adapter")))
        heard, clock = list[Frame](), itertools.count()

        def pass_on() -> None:
            now_s = 0.01 * next(clock)
            port.take(0.0)
            device.tend(now_s)
            if not reached:
                with suppress(BlockingIOError):
                    device.send(BROADCAST, LEAVE_BOOTLOADER, b"")
            elif port.is_open:
                port.send(WireUnit(LONG, None))
            heard.extend(item for item in device.read() if isinstance(item, Frame))

        until(lambda: reached and heard, pass_on)
        assert {frame._replace(t=0.0) for frame in (*reached, *heard)} == {LONG}
        device.close()


def test_a_frame_with_a_long_id_goes_to_python_cans_busses_as_such() -> None:
    with can.Bus(interface="virtual", channel="long") as bus:
        config = SourceConfig(kind="can", interface="virtual", channel="long")
        device = open_device(config)
        device.send(BROADCAST, LEAVE_BOOTLOADER, b"")
        message = bus.recv(PATIENCE_S)
        assert message is not None
        assert (message.arbitration_id, message.is_extended_id) == (LONG.can_id, True)
        bus.send(can.Message(arbitration_id=LONG.can_id, data=LONG.data, is_extended_id=True))
        (frame,) = device.read()
        assert frame._replace(t=0.0) == LONG
        device.close()


@pytest.mark.parametrize("bitrate", BITRATES)
def test_the_bus_gets_the_configured_bit_rate(opened: Opened, bitrate: int) -> None:
    skin = opened("lawicel", at="@921600", bitrate=bitrate, period_ms=300)
    skin.until(lambda: b"O" in skin.adapter.heard)
    assert [line for line in skin.adapter.heard if line[:1] == b"S"] == [BITRATES[bitrate]]


@pytest.mark.parametrize("speed", ["fast", "", "300", "9" * 400, "-9600", "96 00"])
def test_a_line_speed_that_is_none_is_refused(speed: str) -> None:
    with pytest.raises(SetupError, match="must end with @ and a line speed, as /dev/null@115200"):
        open_source(configured(f"/dev/null@{speed}"), SKIN)
