"""Devices that go and come back, and recordings of what came."""

import time
from pathlib import Path

import pytest

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.source.sources import LiveSource, open_source
from taxeld_protocol import serial_link
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Chunk, Frame
from taxeld_protocol.virtual_ihb import VirtualIhb
from tests.rig.clocks import until
from tests.rig.sessions import read
from tests.rig.skins import CHANNELS, MODULES, SKIN
from tests.rig.virtual_hub import VirtualHub


@pytest.mark.parametrize("native", [True, False], ids=["native", "SLCAN"])
def test_a_skin_that_is_unplugged_comes_back(tmp_path: Path, native: bool) -> None:
    hub = VirtualHub(tmp_path / "skin", MODULES, native=native)
    kind = "serial" if native else "can"
    source = open_source(SourceConfig(kind=kind, interface="slcan", channel=hub.device), SKIN)
    assert isinstance(source, LiveSource)

    scans: list[Scan] = []

    def poll() -> None:
        if Path(hub.device).exists():
            hub.serve(time.monotonic(), lambda number: [number + 1] * CHANNELS)
        scans.extend(source.poll(time.monotonic()))

    until(lambda: len(scans) >= 3, poll)
    hub.unplug()
    until(lambda: source.counters.lost == 1, poll)
    time.sleep(0.3)
    assert source.poll(time.monotonic()) == []
    hub.plug()
    before = hub.scans
    until(lambda: source.decoder.counters.scans >= 8, poll)
    assert source.counters.reopened == 1
    assert scans[-1].counts[0] > before
    assert hub.ihb.auto_sync
    source.close()
    hub.unplug()


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
    assert read(tmp_path / "s") == (items(), [(50.0, 0.1, -0.2, 3.0)])


def test_a_can_recording_is_read_back_as_it_came(tmp_path: Path) -> None:
    frames = [Frame(1.25, 0x101, b"\x43\x00"), Frame(1.5, 0x18DAF110, b"", True)]
    with Recorder(tmp_path / "s", moves=False) as recorder:
        for frame in frames:
            recorder.take(frame)
    assert read(tmp_path / "s") == (frames, [])
    assert not (tmp_path / "s" / session.POSES).exists()


@pytest.mark.parametrize(
    ("times", "fault"),
    [
        ("t,row\n", "must begin with the line t,offset"),
        ("t,offset\n1.0,0\n2.0,nine\n", "line 3 is not t,offset"),
        ("t,offset\n1.0,5\n", "offsets do not begin at 0"),
        ("t,offset\n1.0,0\n2.0,9\n3.0,8\n", "offsets do not begin at 0, or fall"),
        ("t,offset\n", "holds no frames"),
    ],
)
def test_a_damaged_serial_recording_is_one_line(tmp_path: Path, times: str, fault: str) -> None:
    (tmp_path / session.SERIAL).write_bytes(bytes(20))
    (tmp_path / session.SERIAL_TIMES).write_text(times, encoding="ascii")
    with pytest.raises(SetupError, match=fault):
        read(tmp_path)
