"""Logs of every kind, told by what is in them: the same frames, and of damage the rest."""

import gzip
import json
import os
import random
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld.commands.decode import decode
from taxeld.errors import SetupError
from taxeld.source.logs.files import LogFile
from taxeld.source.logs.formats import are_differences
from taxeld.source.logs.text import Damage
from taxeld.source.module_order import Given
from taxeld.source.recorder import Recorder
from taxeld.source.session import Chunk
from taxeld_protocol import cyskin, serial_link, slcan
from taxeld_protocol.frames import Frame
from taxeld_protocol.virtual_ihb import VirtualIhb

from .log_writers import (
    BEFORE_SCANS,
    MILLISECONDS,
    MODULES,
    START_S,
    UNTIMED,
    WRITERS,
    Write,
    bus,
    candump_log,
    counts,
    decoded,
    frames_of,
    said,
    trc,
    values_of,
)

FRAMES = bus()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A file whose name tells nothing."""
    return tmp_path / "recording"


@pytest.fixture(params=["", "Asia/Kathmandu"])
def zone(request: pytest.FixtureRequest) -> Iterator[None]:
    """Of this machine, in which a date is written and read."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param:
            patch.setenv("TZ", request.param)
        time.tzset()
        yield
    time.tzset()


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gzip"])
@pytest.mark.parametrize("kind", WRITERS)
def test_a_log_of_any_kind_gives_the_same_scans_at_the_same_times(
    log: Path, kind: str, packed: bool
) -> None:
    WRITERS[kind](FRAMES, log)
    if packed:
        log.write_bytes(gzip.compress(log.read_bytes()))
    scans, stats = decoded(log)
    assert [scan["modules"] for scan in scans] == counts()
    assert stats["frames"] == len(FRAMES)
    assert stats["dropped"]["foreign"] == 2  # type: ignore[index]
    assert stats["bad_lines"] == 0
    between = [float(scan["t"]) - float(scans[0]["t"]) for scan in scans]  # type: ignore[arg-type]
    expected = [0.0 if kind in UNTIMED else 0.05 * k for k in range(len(scans))]
    assert between == pytest.approx(expected, abs=0.002 if kind in MILLISECONDS else 1e-5)


@pytest.mark.usefixtures("zone")
@pytest.mark.parametrize("kind", ["candump -t A", "candump -L -t A", "blf by python-can"])
def test_a_log_that_tells_the_time_of_day_gives_unix_time(log: Path, kind: str) -> None:
    WRITERS[kind](FRAMES, log)
    found, _ = frames_of(log)
    assert [frame.t for frame in found if frame] == pytest.approx([f.t for f in FRAMES], abs=1e-5)


@pytest.mark.parametrize("ending", ["log", "asc", "trc", "csv", "blf", "db"])
def test_what_python_can_reads_is_read_as_it_reads_it(tmp_path: Path, ending: str) -> None:
    kinds = {"db": "SQLite", "log": "candump log by python-can"}
    path = tmp_path / f"a.{ending}"
    WRITERS[kinds.get(ending, f"{ending} by python-can")](FRAMES, path)
    with can.LogReader(path) as reader:
        theirs = [
            Frame(m.timestamp, m.arbitration_id, bytes(m.data), m.is_extended_id) for m in reader
        ]
    ours, damage = frames_of(path)
    assert damage.count == 0
    assert [frame and frame[1:] for frame in ours] == [frame[1:] for frame in theirs]
    times = [frame.t for frame in ours if frame]
    assert times == pytest.approx([frame.t for frame in theirs], abs=1e-6)


def test_differences_go_on_over_what_is_no_frame_and_over_other_interfaces(log: Path) -> None:
    passed = [0.0, 0.00011, 0.03, *(0.0001 + 1e-5 * (7 * k % 10) for k in range(57))]
    lines = [f" ({t:010.6f})  can{k % 2}  101   [1]  43" for k, t in enumerate(passed)]
    lines[2] = " (000.030000)  can0  101   [3]  remote request"
    log.write_text("\n".join(lines), encoding="ascii")
    with LogFile(log) as file:
        logged = [entry for batch in file.frames(Damage()) for entry in batch]
    found = {k: frame.t for k, (_, frame) in enumerate(logged) if frame is not None}
    assert found == pytest.approx({k: sum(passed[: k + 1]) for k in range(60) if k != 2})


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 10.0), min_size=1, max_size=300), st.floats(0.0, 2e9))
def test_times_are_no_differences(steps: list[float], start: float) -> None:
    assert not are_differences([start + 0.01 + sum(steps[:k]) for k in range(len(steps))])


@given(st.integers(2, 40), st.integers(1, 40), st.integers(0, 1000))
@settings(deadline=None)
def test_the_pauses_of_a_scanning_hub_are_differences(frames: int, scans: int, seed: int) -> None:
    """Frames back to back, with the jitter of a kernel, and a pause before the next scan."""
    rng = random.Random(seed)
    pauses = [
        0.05 + rng.uniform(-1e-3, 1e-3) if k % frames == 0 else 1.1e-4 + rng.uniform(0.0, 5e-5)
        for k in range(frames * scans)
    ]
    assert are_differences([0.0, *(round(pause, 6) for pause in pauses)])


def test_equal_pauses_are_differences_but_equal_times_are_none() -> None:
    assert are_differences([0.0, *[0.00025] * 50])
    assert not are_differences([1.0] * 50)
    assert not are_differences([0.0] * 50)
    assert not are_differences([0.0] * 20 + [0.05] * 20 + [0.1] * 20)


def test_a_clock_that_is_set_back_makes_no_differences_of_times() -> None:
    assert not are_differences([*(1.7e9 + 0.01 * k for k in range(50)), *range(50)])


def two_interfaces(log: Path) -> None:
    other = [frame._replace(can_id=0x105) for frame in FRAMES if frame.can_id != 0x7F0]
    paths = [log.with_name(name) for name in ("0", "1")]
    candump_log("a", "can0")(FRAMES, paths[0])
    candump_log("a", "can1")(other, paths[1])
    lines = [line for path in paths for line in path.read_text(encoding="ascii").splitlines()]
    log.write_text("\n".join(sorted(lines)) + "\n", encoding="ascii")


def test_of_several_interfaces_one_is_to_be_named(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two_interfaces(log)
    assert "interfaces, can0, can1; name the skin's with --interface" in said(log, capsys)
    assert "no frame of can2; it has those of can0, can1" in said(
        log, capsys, "--interface", "can2"
    )
    scans, stats = decoded(log, "can0")
    assert [scan["modules"] for scan in scans] == counts()
    assert stats["frames"] == len(FRAMES)
    assert decoded(log, "can1")[1]["frames"] == len(FRAMES) - 1


def test_an_interface_that_comes_late_is_found_before_a_scan_is_printed(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    candump_log("a")(bus(2000), log)
    with log.open("a", encoding="ascii") as file:
        file.write("(1700000999.0) vcan7 101#43\n")
    assert log.stat().st_size > 1 << 19
    assert "can0, vcan7" in said(log, capsys)


def test_a_log_without_interfaces_takes_no_name(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    WRITERS["csv by python-can"](FRAMES, log)
    assert "it names no interface; leave this out" in said(log, capsys, "--interface", "can0")


@pytest.mark.parametrize("write", [trc("2.1", "NOTBIdRLD", ";$COLUMNS=N,O,T,B,I,d,R,L,D"),
                                   WRITERS["asc"], WRITERS["blf by python-can"]],
                         ids=["trc", "asc", "blf"])  # fmt: skip
def test_channels_are_interfaces_by_their_number(log: Path, write: Write) -> None:
    write(FRAMES, log)
    assert len(decoded(log, "1")[0]) == 6
    with pytest.raises(SetupError, match="no frame of 2; it has those of 1"):
        list(decode(log, interface="2"))


@pytest.mark.parametrize("framing", ["native", "slcan"])
def test_the_bytes_of_a_recorded_serial_line_are_decoded_with_their_times(
    tmp_path: Path, framing: str
) -> None:
    hub = VirtualIhb(MODULES)
    with Recorder(tmp_path / "session", moves=False) as recorder:
        for scan in range(6):
            line = b"\x00\rnoise"
            for command, payload in hub.sensor_data(values_of(scan)):
                line += (
                    serial_link.DELIMITER + serial_link.encode(command, payload, ihb=1)
                    if framing == "native"
                    else b"".join(b"\r" + slcan.encode(f) for f in cyskin.to_frames(
                        command, payload, ihb=1))
                )  # fmt: skip
            for at in range(0, len(line), 50):
                recorder.take(Chunk(START_S + 0.05 * scan + 1e-6 * at, line[at : at + 50]))
    log = tmp_path / "session" / "serial.bin"
    modules = list(decode(log, Given([(m.sui, m.mask) for m in MODULES])))
    scans, stats = [json.loads(line) for line in modules[:-1]], json.loads(modules[-1])["stats"]
    assert [scan["modules"] for scan in scans] == counts()
    assert [scan["t"] for scan in scans] == pytest.approx(
        [START_S + 0.05 * k for k in range(6)], abs=1e-3
    )
    assert stats["bytes"] == log.stat().st_size
    assert stats["bytes_used"] + stats["bytes_dropped"] == stats["bytes"]
    assert stats["bad_lines"] == 0


def test_what_comes_through_a_pipe_is_read(tmp_path: Path) -> None:
    log, pipe = tmp_path / "log", tmp_path / "pipe"
    WRITERS["SQLite"](FRAMES, log)
    os.mkfifo(pipe)
    writer = threading.Thread(target=lambda: pipe.write_bytes(log.read_bytes()))
    writer.start()
    scans, _ = decoded(pipe)
    writer.join()
    assert len(scans) == 6


def test_the_frames_of_a_log_are_read_once_where_hubs_declare_their_modules(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passes = []
    monkeypatch.setattr(
        LogFile, "frames", lambda self, damage, read=LogFile.frames: passes.append(1) or read(
            self, damage)
    )  # fmt: skip
    WRITERS["candump -L -t a"](FRAMES, log)
    assert len(decoded(log)[0]) == 6
    assert len(passes) == 1
    WRITERS["candump -L -t a"](FRAMES[BEFORE_SCANS:], log)
    assert len(decoded(log)[0]) == 6
    assert len(passes) == 3
