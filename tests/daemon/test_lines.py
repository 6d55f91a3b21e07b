"""Serial lines on pseudo-terminals: a hub's own link, and SLCAN adapters of several kinds."""

import itertools
import logging
import math
import os
import resource
import select
import termios
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

from taxeld.config.tables import SourceConfig
from taxeld.source import session
from taxeld.source.lines import SerialLine
from taxeld.source.opening import open_device
from taxeld.source.recorder import Recorder
from taxeld.source.session import Pass
from taxeld.source.sources import LiveSource
from taxeld_hil.rig.adapters import Adapter
from taxeld_hil.rig.virtual_ihb import Answer, Phase, VirtualIhb
from taxeld_protocol.cyskin import Command, Packet
from taxeld_protocol.decoder import Scan
from taxeld_protocol.serial_link import SerialReader
from taxeld_protocol.slcan import BITRATES
from tests.rig.adapters import KINDS
from tests.rig.clocks import until
from tests.rig.far_end import FarEnd, LateAdapter
from tests.rig.given_device import GivenDevice
from tests.rig.sessions import recorded_inputs
from tests.rig.skins import CHANNELS, LISTED, MODULES, SKIN
from tests.rig.virtual_hub import LateHub, StuckHub, VirtualHub, frames_of

TICK_S = 0.01
NATIVE = "native"

adapters = pytest.mark.parametrize("kind", KINDS)
LISTENING: dict[str, Any] = {"listen_only": True, "modules": LISTED}
transports = pytest.mark.parametrize("kind", ["plain", NATIVE])


class ServedSkin(ExitStack):
    """A source, and a hub behind a line, on a clock that stands while the test does not run."""

    def __init__(
        self, place: Path, kind: str, at: str, recorder: Recorder | None, *, away: bool, **more: Any
    ) -> None:
        super().__init__()
        native = kind == NATIVE
        adapter = "plain" if native else kind
        self.hub = VirtualHub(place / "skin", MODULES, native=native, adapter=adapter)
        self.enter_context(self.hub)
        if away:
            self.hub.unplug()
        if more.get("listen_only"):  # something else has started it
            self.hub.ihb.phase, self.hub.ihb.auto_sync = Phase.RUNNING, True
            self.hub.port.is_open = native
        keys: dict[str, Any] = {**self.hub.source, "channel": self.hub.device + at, **more}
        self.scans, self.now_s = list[Scan](), 0.0
        given = SourceConfig(**keys), {0: SKIN}, open_device, recorder
        self.source = LiveSource(*given, wait=True, clock=lambda: self.now_s)
        self.callback(self.source.close)

    @property
    def adapter(self) -> Adapter:
        return self.hub.port.adapter

    def turn(self, *, polls: bool = True) -> None:
        """Serve the hub, whose scan k reads k + 1 everywhere, and poll."""
        self.now_s = round(self.now_s + TICK_S, 6)
        if Path(self.hub.device).exists():
            self.hub.serve(self.now_s, lambda k: [k + 1] * CHANNELS)
        if polls:
            self.scans += self.source.poll(self.now_s)

    def until(self, true: Callable[[], Any]) -> float:
        """Go on until something is so; → by the clock, how long it took."""
        began_s = self.now_s
        until(true, self.turn)
        return self.now_s - began_s

    def more(self, scans: int = 3) -> float:
        """Until so many more have come. None is damaged."""
        wanted = len(self.scans) + scans
        took_s = self.until(lambda: len(self.scans) >= wanted)
        assert all({*scan.counts} == {scan.counts[0]} for scan in self.scans)
        return took_s


Opened = Callable[..., ServedSkin]


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Opened]:
    """A skin behind a kind of adapter or a native link, and more keys of its source."""
    with ExitStack() as stack:

        def made(
            kind: str = "plain",
            at: str = "",
            recorder: Recorder | None = None,
            away: bool = False,
            **more: Any,
        ) -> ServedSkin:
            skin = ServedSkin(tmp_path, kind, at, recorder, away=away, **more)
            return stack.enter_context(skin)

        yield made


@pytest.mark.parametrize("listens", [False, True])
@adapters
def test_the_skin_behind_each_kind_of_adapter_is_started_and_stopped_or_only_listened_to(
    opened: Opened, kind: str, listens: bool
) -> None:
    """Then nothing is sent to the bus, and the adapter is told so."""
    skin = opened(kind, **(LISTENING if listens else {}))
    skin.more()
    assert skin.adapter.is_silent is listens
    skin.source.close()
    until(lambda: not skin.adapter.is_open, lambda: skin.hub.answer(skin.now_s))
    assert skin.hub.ihb.auto_sync is listens
    assert bool(skin.hub.requests) is not listens


@adapters
def test_a_channel_that_another_process_closed_is_opened_again_and_said_once(
    opened: Opened, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    skin = opened(kind)
    skin.more()
    caplog.clear()
    port = skin.hub.port
    if kind == "lawicel":  # as a shell's `stty sane` does: then it echoes, and gives whole lines
        form = termios.tcgetattr(port.slave)
        form[0] |= termios.ICRNL
        form[3] |= termios.ICANON | termios.ECHO
        termios.tcsetattr(port.slave, termios.TCSANOW, form)
    port.close_channel()
    took_s = skin.until(lambda: bool(skin.source.waits_for))
    named = f"source.channel: nothing has come from {skin.hub.device} for 1 s; "
    assert skin.source.waits_for.startswith(named)
    assert took_s + skin.more(1) <= 1.0 + 2.0
    assert (skin.source.waits_for, skin.source.counters.lost) == ("", 0)
    said = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert [level for level, _ in said] == ["WARNING", "INFO"]
    assert said[1][1] == f"no longer: {said[0][1]}"


class QuietHub(LateHub):
    """It says nothing while its modules start."""

    wakes_s = -math.inf

    def answer(self, packet: Packet) -> list[Answer]:
        if packet.t < self.wakes_s:
            return []
        if packet.command == Command.MODULE_PROGRAM_END:
            self.wakes_s = packet.t + 1.6
        return super().answer(packet)


@pytest.mark.parametrize("hub", [QuietHub(MODULES, modules_s=1.6), StuckHub(MODULES)])
def test_the_channel_of_a_hub_that_answers_is_not_opened_again_while_it_is_started(
    opened: Opened, hub: VirtualIhb, caplog: pytest.LogCaptureFixture
) -> None:
    """Also between two rounds, in which nobody speaks."""
    skin = opened()
    skin.hub.ihb = hub
    took_s = skin.until(lambda: skin.scans or skin.now_s > 14.0)
    assert (took_s < 6.0) is isinstance(hub, QuietHub)
    assert "its channel is opened again" not in caplog.text
    assert skin.source.waits_for.startswith("hub 1 stays in its bootloader" * (not skin.scans))
    assert skin.source.counters.unsent == 0


def test_foreign_frames_are_counted_and_damaged_lines_cost_only_themselves(opened: Opened) -> None:
    skin = opened("lawicel")
    skin.more()
    strange = b"r1010\rR17FFFFFF8\rr10181A2B\rd1011AA\rB000001019" + b"00" * 12 + b"\r"
    noise = [b"t1ZZ8junk\r", b"\xff\xfe\r", b"t\r", b"T123\r", b"\x07", b"tttt\r"]

    for data in (strange, *noise):
        os.write(skin.hub.port.fileno(), data)
        skin.more(1)
    skin.until(lambda: skin.source.decoder.stats()["dropped"]["foreign"] == 5)  # type: ignore[index]
    assert skin.source.counters.lost == 0


@pytest.mark.parametrize(("refuses", "listens"), [(False, False), (False, True), (True, False)])
@pytest.mark.parametrize("late_s", [0.0, 0.08, 0.15])
@pytest.mark.parametrize("mute", [b"", b"C"], ids=["answers C", "does not answer C"])
def test_an_adapter_that_answers_late_is_opened_or_named_with_the_bit_rate_that_it_refuses(
    refuses: bool,
    listens: bool,
    late_s: float,
    mute: bytes,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No answer of its own is taken for a refusal."""
    if refuses:
        monkeypatch.setitem(BITRATES, 1_000_000, b"S9")  # Lawicel's knows no such
    tick = itertools.count()
    with closing(LateAdapter(late_s, mute)) as late:
        config = SourceConfig("can", "slcan", late.device, **(LISTENING if listens else {}))
        with closing(LiveSource(config, {0: SKIN}, open_device)) as source:

            def turn() -> None:
                now_s = TICK_S * next(tick)
                source.poll(now_s)
                late.serve(now_s)

            # the skin is silent, so that the channel is opened twice
            until(lambda: source.waits_for and (refuses or late.adapter.on_bus), turn)
            for _ in range(50):
                turn()
            assert refuses or late.adapter.is_silent == listens
    said = [text for text in caplog.messages if "refused" in text]
    named = f"source.channel: {late.device} refused S9 (it knows no such bit rate"
    assert [text for text in said if text.startswith(named)] == said[:1], "once"
    assert bool(said) is refuses
    # without a bit rate its channel does not open, and takes nothing
    assert all(text.split()[3][0] in "OtT" for text in said[1:]), said


@pytest.mark.parametrize("bitrate", BITRATES)
def test_the_bus_gets_the_configured_bit_rate(opened: Opened, bitrate: int) -> None:
    skin = opened("lawicel", at="@921600", bitrate=bitrate, period_ms=300)
    skin.until(lambda: b"O" in skin.adapter.heard)
    assert [line for line in skin.adapter.heard if line[:1] == b"S"] == [BITRATES[bitrate]]


@transports
def test_a_skin_that_is_not_there_yet_or_no_more_is_waited_for_with_one_line(
    opened: Opened, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    skin = opened(kind, away=True)
    for lost in (0, 1):
        skin.until(lambda lost=lost: skin.source.counters.lost == lost)  # type: ignore[misc]
        for _ in range(500):
            skin.turn()
        waits = f"{skin.source.waits_for}; waiting for it"
        assert lost or caplog.messages == [waits]
        assert bool(skin.source.waits_for)
        skin.hub.plug()
        skin.more()
        assert skin.source.waits_for == ""
        assert skin.hub.ihb.auto_sync
        skin.hub.unplug()
    assert skin.source.counters.unopened >= 4


@pytest.mark.parametrize(("kind", "began"), [("plain", True), (NATIVE, True), (NATIVE, False)])
def test_what_waited_on_a_line_while_the_loop_was_stopped_or_had_not_begun_is_dropped_and_counted(
    opened: Opened, kind: str, began: bool, tmp_path: Path
) -> None:
    """Nothing tells when it came, and the robot may have moved meanwhile. Between opening the
    device and the first pass, samplers and models are loaded."""
    with Recorder(tmp_path / "session", moves=False) as recorder:
        skin = opened(kind, recorder=recorder, **({} if began else LISTENING))
        skin.more(3 * began)
        before, taken = skin.hub.scans, len(skin.scans)
        for _ in range(102):  # no scan is due in the next pass
            skin.turn(polls=False)
        missed = skin.hub.scans - before
        assert missed >= 15
        skin.more()
        now = skin.hub.scans
        assert [s.counts[0] for s in skin.scans[taken:]] == [now - 2, now - 1, now]
        assert skin.source.counters.late - missed in (0, 1), "and one that came at once after it"
        skin.source.close()


def test_what_a_line_gives_bit_by_bit_after_a_stop_is_dropped_until_a_pause_also_in_the_replay(
    tmp_path: Path,
) -> None:
    """The system passes on what had waited in pieces, within milliseconds."""
    keys = {"kind": "can", "interface": "slcan", "channel": "x"}
    config, device, used = SourceConfig(**keys, **LISTENING), GivenDevice(), list[Scan]()
    with Recorder(tmp_path / "session", moves=False) as recorder:
        source = LiveSource(config, {0: SKIN}, lambda _: device, recorder)
        for k, now_s in enumerate((0.01, 0.06, 9.0, 9.001, 9.02, 9.05, 9.1)):
            device.frames = frames_of(VirtualIhb(MODULES).sensor_data([k + 1] * CHANNELS), t=now_s)
            used += source.poll(now_s)
            recorder.take(Pass(now_s))
    assert [scan.counts[0] for scan in used] == [1, 2, 6, 7]
    assert source.counters.late == 3
    inputs, found = recorded_inputs(tmp_path / "session", source=keys | LISTENING), list[Scan]()
    for arrival in session.arrivals(tmp_path / "session"):
        inputs.take(arrival)
        found += inputs.scans() if isinstance(arrival.item, Pass) else []
    assert found == used


@pytest.fixture
def far_end() -> Iterator[FarEnd]:
    with closing(FarEnd()) as made:
        yield made


def of_kind(kind: str, device: str) -> SourceConfig:
    native = kind == NATIVE
    return SourceConfig("serial" if native else "can", interface="slcan", channel=device)


@transports
def test_a_line_whose_far_end_stops_reading_makes_no_tick_wait(
    far_end: FarEnd, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = LiveSource(of_kind(kind, far_end.device), {0: SKIN}, open_device)
    far_end.fill()
    real = select.select

    def spy(r: Any, w: Any, x: Any, timeout: float | None = None) -> Any:
        assert timeout == 0, f"waited for {timeout} s"
        return real(r, w, x, timeout)

    def drain(_: int) -> None:
        raise AssertionError("waited for a line to be empty")

    monkeypatch.setattr(select, "select", spy)
    monkeypatch.setattr(termios, "tcdrain", drain)
    for tick in range(2000):
        source.poll(tick * TICK_S)
    assert 5 <= source.counters.unsent <= 2000 * TICK_S
    assert source.counters.lost == 0
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
    device = open_device(of_kind(NATIVE, far_end.device))
    device.send(1, Command.DECLARE, b"")
    with pytest.raises(BlockingIOError):
        device.send(2, Command.DECLARE, b"")
    room = 100
    device.send(3, Command.DECLARE, b"")
    assert [packet.ihb for packet in SerialReader().feed(taken, 0.0)] == [1, 3]
    device.close()


@transports
def test_a_line_is_read_beside_a_thousand_inherited_descriptors(opened: Opened, kind: str) -> None:
    """Where it gets a number that `select` does not take."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 4096), hard))
    with ExitStack() as inherited:
        for _ in range(1100):
            inherited.enter_context(Path(os.devnull).open())
        skin = opened(kind)
        skin.more()
        skin.source.close()
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
