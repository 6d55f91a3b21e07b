"""Devices that go and come back, and recordings of what came."""

import csv
import os
import subprocess
import sys
import time
import tty
from collections.abc import Callable
from pathlib import Path
from shutil import which

import pytest

from taxeld import layout, session
from taxeld.cli import main
from taxeld.config import SkinConfig, SourceConfig
from taxeld.errors import SetupError
from taxeld.layout import Layout
from taxeld.session import Chunk, Recorder
from taxeld.sources import LiveSource, open_source
from taxeld_hil.adapter import SlcanAdapter
from taxeld_protocol import serial_link
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import wired
from taxeld_protocol.serial_link import SerialReader
from taxeld_protocol.virtual_ihb import VirtualIhb

SPEC = "cylinder:rows=2,columns=8,radius_m=0.04,pitch_m=0.015"
SKIN = layout.load(SPEC)
MODULES = wired(SKIN.uid.tolist())
CHANNELS = sum(module.channels for module in MODULES)
DEADLINE_S = 20.0


class NativeHub:
    """A hub on the native serial link behind a device name that outlives its terminals."""

    def __init__(self, link: Path, skin: Layout = SKIN) -> None:
        self.link = link
        self.hub = VirtualIhb(wired(skin.uid.tolist()))
        self.sent = 0
        self.plug()

    def plug(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.link.symlink_to(os.ttyname(self.slave))
        self.requests = SerialReader()

    def unplug(self) -> None:
        os.close(self.master)
        os.close(self.slave)
        self.link.unlink()
        self.hub.auto_sync = False  # it has lost its power

    def serve(self) -> None:
        try:
            data = os.read(self.master, 4096)
        except BlockingIOError:
            data = b""
        answers = [a for p in self.requests.feed(data, 0.0) for a in self.hub.answer(p)]
        if self.hub.due(time.monotonic()):
            self.sent += 1
            channels = sum(module.channels for module in self.hub.modules)
            answers += self.hub.sensor_data([self.sent] * channels)
        for command, payload in answers:
            os.write(self.master, serial_link.encode(command, payload, ihb=self.hub.short_id))


def run(source: LiveSource, serve: Callable[[], None], until: Callable[[], bool]) -> list[Scan]:
    scans: list[Scan] = []
    deadline = time.monotonic() + DEADLINE_S
    while not until() and time.monotonic() < deadline:
        serve()
        scans += source.poll(time.monotonic())
        time.sleep(0.002)
    assert until()
    return scans


def test_a_skin_that_is_unplugged_comes_back(tmp_path: Path) -> None:
    hub = NativeHub(tmp_path / "skin")
    source = open_source(SourceConfig(kind="serial", channel=str(hub.link)), SKIN)
    assert isinstance(source, LiveSource)
    run(source, hub.serve, lambda: source.wire.decoder.counters.scans >= 3)
    hub.unplug()
    run(source, lambda: None, lambda: source.counters.lost == 1)
    time.sleep(0.3)
    assert source.poll(time.monotonic()) == []
    hub.plug()
    before = hub.sent
    scans = run(source, hub.serve, lambda: source.wire.decoder.counters.scans >= 8)
    assert source.counters.reopened == 1
    assert scans[-1].counts[0] > before
    assert hub.hub.auto_sync
    source.close()
    os.close(hub.master)
    os.close(hub.slave)


def test_slcan_framing_on_a_serial_line_brings_the_skin_up() -> None:
    with SlcanAdapter(VirtualIhb(MODULES), lambda _: None) as adapter:
        config = SourceConfig(kind="serial", framing="slcan", channel=adapter.device)
        source = open_source(config, SKIN)
        assert isinstance(source, LiveSource)
        sent = 0

        def serve() -> None:
            nonlocal sent
            adapter.serve(time.time())
            os.write(adapter.fileno(), b"\xff\xfet1ZZ\r")  # noise between all good lines
            if adapter.ihb.due(time.monotonic()):
                for answer in adapter.ihb.sensor_data([sent + 1] * CHANNELS):
                    adapter.send(*answer, time.time())
                sent += 1

        scans = run(source, serve, lambda: source.wire.decoder.counters.scans >= 4)
        assert [scan.counts[0] for scan in scans] == [1, 2, 3, 4]
        assert all(scan.complete for scan in scans)
        source.close()


def items() -> list[Chunk]:
    """A hub's answers and three scans as a serial line brings them, in odd pieces."""
    hub = VirtualIhb(MODULES)
    line = b""
    for k in range(3):
        for command, payload in hub.sensor_data([100 * (k + 1)] * CHANNELS):
            line += serial_link.encode(command, payload, ihb=1)
    return [Chunk(50.0 + i / 100, line[i : i + 13]) for i in range(0, len(line), 13)]


def test_a_serial_recording_is_read_back_as_it_came(tmp_path: Path) -> None:
    with Recorder(tmp_path / "s", moves=True) as recorder:
        for chunk in items():
            recorder.take(chunk)
        recorder.pose(50.0, 0.1, -0.2, 3.0)
    assert session.read_input(tmp_path / "s") == items()
    assert session.read_poses(tmp_path / "s" / session.POSES) == [(50.0, 0.1, -0.2, 3.0)]


def test_a_can_recording_is_read_back_as_it_came(tmp_path: Path) -> None:
    frames = [Frame(1.25, 0x101, b"\x43\x00"), Frame(1.5, 0x18DAF110, b"", True)]
    with Recorder(tmp_path / "s", moves=False) as recorder:
        for frame in frames:
            recorder.take(frame)
    assert session.read_input(tmp_path / "s") == frames
    assert not (tmp_path / "s" / session.POSES).exists()


def test_a_session_is_never_recorded_over(tmp_path: Path) -> None:
    with Recorder(tmp_path, moves=False) as recorder:
        recorder.take(Frame(0.0, 1, b""))
    with pytest.raises(SetupError, match="holds a session already"):
        Recorder(tmp_path, moves=False)


@pytest.mark.parametrize(
    ("times", "fault"),
    [
        ("", "must begin with the line t,offset"),
        ("t,offset\n1.0,0\n2.0,nine\n", "line 3 is not t,offset"),
        ("t,offset\n1.0,0\n2.0,999999\n", "offsets do not fit"),
        ("t,offset\n1.0,5\n", "offsets do not fit"),
        ("t,offset\n", "offsets do not fit"),
    ],
)
def test_a_damaged_serial_recording_is_one_line(tmp_path: Path, times: str, fault: str) -> None:
    (tmp_path / session.SERIAL).write_bytes(bytes(20))
    (tmp_path / session.SERIAL_TIMES).write_text(times, encoding="ascii")
    with pytest.raises(SetupError, match=fault):
        session.read_input(tmp_path)


def test_record_and_replay_a_serial_skin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`taxeld record` on a real line, ended by SIGTERM; the session then replays."""
    hub = NativeHub(tmp_path / "skin", layout.load(SkinConfig().layout))
    config = tmp_path / "config.toml"
    config.write_text(
        f'[source]\nkind = "serial"\nchannel = "{hub.link}"\n[scene]\nbundle = "box"\n'
        "[skin]\nbaseline_scans = 2\n",
        encoding="utf-8",
    )
    out = tmp_path / "session"
    command = [sys.executable, "-m", "taxeld.cli", "record", "--out", str(out), str(config)]
    recorder = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + DEADLINE_S
    while hub.sent < 8 and time.monotonic() < deadline:
        hub.serve()
        time.sleep(0.002)
    time.sleep(0.2)
    recorder.terminate()
    printed, errors = recorder.communicate(timeout=DEADLINE_S)
    assert errors == ""
    assert "8 scans, 0 sensor poses" in printed
    assert (out / session.CONFIG).read_text(encoding="utf-8") == config.read_text(encoding="utf-8")
    assert main(["replay", str(out)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 8
    os.close(hub.master)
    os.close(hub.slave)


def test_a_recorded_log_is_one_that_log2asc_reads(tmp_path: Path) -> None:
    """can-utils' own reader of candump logs; it is installed where CI runs."""
    if which("log2asc") is None:
        pytest.skip("can-utils is not installed")
    frames = [Frame(1.25, 0x101, b"\x43\x00"), Frame(1.5, 0x18DAF110, b"\x01", True)]
    with Recorder(tmp_path / "s", moves=False) as recorder:
        for frame in frames:
            recorder.take(frame)
    log = tmp_path / "s" / session.FRAMES
    done = subprocess.run(
        ["log2asc", "-I", str(log), "can0"], capture_output=True, text=True, check=True
    )
    rows = list(csv.reader(done.stdout.splitlines(), delimiter=" ", skipinitialspace=True))
    data = [row for row in rows if "Rx" in row]
    assert [row[2] for row in data] == ["101", "18DAF110x"]
    assert data[0][-2:] == ["43", "00"]


def test_an_slcan_adapter_of_python_cans_that_is_unplugged_comes_back(tmp_path: Path) -> None:
    link = tmp_path / "adapter"
    config = SourceConfig(kind="can", interface="slcan", channel=str(link))
    source = None
    for plugged in range(2):
        with SlcanAdapter(VirtualIhb(MODULES), lambda _: None) as adapter:
            link.symlink_to(adapter.device)
            source = source or open_source(config, SKIN)
            assert isinstance(source, LiveSource)
            hub, device = adapter.ihb, adapter

            def serve(hub: VirtualIhb = hub, device: SlcanAdapter = device) -> None:
                device.serve(time.time())
                if hub.due(time.monotonic()):
                    for answer in hub.sensor_data([7] * CHANNELS):
                        device.send(*answer, time.time())

            counters, wanted = source.wire.decoder.counters, 3 * (plugged + 1)
            scans = run(source, serve, lambda n=wanted, c=counters: c.scans >= n)
            assert scans[-1].counts == (7,) * CHANNELS
        link.unlink()
        run(source, lambda: None, lambda n=plugged, s=source: s.counters.lost == n + 1)
    assert source is not None
    assert source.counters.reopened == 1
    source.close()
