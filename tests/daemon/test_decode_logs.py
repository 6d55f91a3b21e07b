"""Logs: each form gives the same scans, and a damaged one the rest, or one line."""

import json
import tracemalloc
from pathlib import Path

import pytest

from taxeld.commands.decode import LINE_MAX, decode
from taxeld.source.recorder import Recorder
from taxeld_protocol import serial_link
from taxeld_protocol.frames import Chunk
from taxeld_protocol.virtual_ihb import VirtualIhb
from tests.rig.commands import refused
from tests.rig.log_writers import (
    BEFORE_SCANS,
    MODULES,
    START_S,
    WRITERS,
    bus,
    candump_log,
    counts,
    decoded,
    values_of,
    written,
)

FRAMES = bus()


@pytest.mark.parametrize("name", WRITERS)
def test_a_log_of_each_form_gives_the_same_scans_at_the_same_times(
    tmp_path: Path, name: str
) -> None:
    scans, stats = decoded(written(name, tmp_path))
    assert [scan["modules"] for scan in scans] == counts()
    assert stats["frames"] == len(FRAMES)
    assert stats["dropped"]["foreign"] == 2
    assert stats["bad_lines"] == 0
    between = [scan["t"] - scans[0]["t"] for scan in scans]
    assert between == pytest.approx([0.05 * k for k in range(len(scans))], abs=1e-5)


@pytest.mark.parametrize(
    "line",
    [
        "(1700000000.1) can0 101#R",
        "(1700000000.1) can0 101#R8_9",
        "(1700000000.1) can0 20000088#0000000000000000",
        "(1700000000.1) can0 101##1001122 R",
        "(1700000000.1) can0 00123#81:00:12345678#11223344",
    ],
    ids=["remote", "remote of a length", "error", "FD", "XL"],
)
def test_a_frame_that_carries_nothing_for_a_skin_is_counted_as_foreign(
    tmp_path: Path, line: str
) -> None:
    log = written("candump.log", tmp_path)
    log.write_text(f"{log.read_text()}{line}\n")
    _, stats = decoded(log)
    assert (stats["dropped"]["foreign"], stats["bad_lines"]) == (3, 0)


@pytest.mark.parametrize(
    "line",
    [
        "(1700000000.1) can0 101#4",
        "(1700000000.1) can0 8FF#43",
        "DROPCOUNT: dropped 3 CAN frames on 'can0' socket (total drops 3)",
        f"({'9' * 400}.5) can0 101#43",
        "x" * 5 * LINE_MAX,
        "é\r",
    ],
    ids=range(6),
)
def test_a_damaged_line_costs_only_itself_and_is_counted_and_named_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, line: str
) -> None:
    log = written("candump.log", tmp_path)
    lines = log.read_text().split("\n")
    at = len(lines) // 2
    lines[at:at] = [line, line]
    log.write_text("\n".join(lines), newline="")
    scans, stats = decoded(log)
    assert [scan["modules"] for scan in scans] == counts()
    assert (stats["frames"], stats["bad_lines"]) == (len(FRAMES), 2)
    (message,) = caplog.messages
    assert f"2 bad_lines), at first line {at + 1}: '" in message
    assert message.isprintable()


@pytest.mark.parametrize(
    ("name", "content", "part"),
    [
        ("a.log", b"", "a.log: has no frame; candump -l and -L, "),
        ("a.blf", b"LOGG" + bytes(range(256)) * 40, "'python3 -m can.logconvert LOG OTHER.log'"),
        ("a.log", b" can0  101   [2]  43 1A\n", "has no frame (line 1: 'can0  101   [2]  43 1A')"),
        ("serial.bin", b"\n" * 200_000, "serial.csv: unreadable (No such file"),
    ],
    ids=range(4),
)
def test_a_log_that_cannot_be_read_is_refused_with_one_line(
    tmp_path: Path, name: str, content: bytes, part: str
) -> None:
    (tmp_path / name).write_bytes(content)
    assert part in refused("decode", tmp_path / name)


def test_a_directory_or_a_log_of_several_interfaces_is_refused_with_what_to_name(
    tmp_path: Path,
) -> None:
    assert "of a session its frames.log or serial.bin" in refused("decode", tmp_path)
    log = tmp_path / "any.log"
    candump_log("can0")(FRAMES, log)
    log.write_text("(1700000000.1) can1 101#43\n" + log.read_text())
    assert "interfaces, can0, can1; keep those of the skin's, as by grep" in refused("decode", log)


def test_the_bytes_of_a_recorded_serial_line_are_decoded_with_their_times(tmp_path: Path) -> None:
    hub = VirtualIhb(MODULES)
    with Recorder(tmp_path / "session", moves=False) as recorder:
        for scan in range(6):
            line = b"\x00\rnoise"
            for command, payload in hub.sensor_data(values_of(scan)):
                line += serial_link.DELIMITER + serial_link.encode(command, payload, ihb=1)
            for at in range(0, len(line), 50):
                recorder.take(Chunk(START_S + 0.05 * scan + 1e-6 * at, line[at : at + 50]))
    log = tmp_path / "session" / "serial.bin"
    *lines, last = decode(log, tuple((m.sui, m.mask) for m in MODULES))
    scans, stats = [json.loads(line) for line in lines], json.loads(last)["stats"]
    assert [scan["modules"] for scan in scans] == counts()
    assert [scan["t"] for scan in scans] == pytest.approx(
        [START_S + 0.05 * k for k in range(6)], abs=1e-3
    )
    assert stats["bytes"] == log.stat().st_size
    assert stats["bytes_used"] + stats["bytes_dropped"] == stats["bytes"]
    assert stats["bad_lines"] == 0


def test_a_log_of_any_length_takes_the_same_memory(tmp_path: Path) -> None:
    """Also where it declares its modules at its end: of such a log the beginning waits."""
    log, peaks = tmp_path / "frames.log", []
    for scans in (200, 2000):
        frames = bus(scans)
        candump_log()(frames[BEFORE_SCANS:] + frames[:BEFORE_SCANS], log)
        tracemalloc.start()
        assert sum(1 for _ in decode(log)) == scans + 1
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 100_000
