"""Logs: each form gives the same scans, and a damaged one the rest, or one line."""

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands.decode import LINE_MAX, decode, of_session
from tests.rig.commands import refused
from tests.rig.log_writers import (
    WRITERS,
    bus,
    candump_log,
    counts,
    decoded,
    written,
)

FRAMES, RECORDED = bus(), Path(__file__).parent / "session" / "serial.bin"


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
    ("line", "counted"),
    [
        ("(1700000000.1) can0 101#R", "foreign"),
        ("(1700000000.1) can0 101#R8_9", "foreign"),
        ("(1700000000.1) can0 20000088#0000000000000000", "foreign"),
        ("(1700000000.1) can0 101##1001122 R", "foreign"),
        ("(1700000000.1) can0 00123#81:00:12345678#11223344", "foreign"),
        ("(1700000000.1) can0 101#4", "bad_lines"),
        ("(1700000000.1) can0 8FF#43", "bad_lines"),
        ("DROPCOUNT: dropped 3 CAN frames on 'can0' socket (total drops 3)", "bad_lines"),
        (f"({'9' * 400}.5) can0 101#43", "bad_lines"),
        ("x" * 5 * LINE_MAX, "bad_lines"),
        ("é\r", "bad_lines"),
    ],
    ids=["remote", "remote of a length", "error", "FD", "XL", *"abcdef"],
)
def test_a_foreign_frame_or_a_damaged_line_costs_only_itself_and_is_counted_and_named_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, line: str, counted: str
) -> None:
    log = written("candump.log", tmp_path)
    lines = log.read_text().split("\n")
    at = len(lines) // 2
    log.write_text("\n".join([*lines[:at], line, line, *lines[at:]]), newline="")
    scans, stats = decoded(log)
    assert [scan["modules"] for scan in scans] == counts()
    is_bad = counted == "bad_lines"
    assert (stats["bad_lines"], stats["dropped"]["foreign"]) == (2 * is_bad, 4 - 2 * is_bad)
    said = [f"2 bad_lines), at first line {at + 1}: '" in message for message in caplog.messages]
    assert (said, "".join(caplog.messages).isprintable()) == ([True] * is_bad, True)


BINARY, TWO = b"LOGG" + bytes(range(256)) * 40, b"(1.0) can0 101#43\n(1.0) can1 101#43\n"


@pytest.mark.parametrize(
    ("name", "content", "part"),
    [
        ("a.log", b"", "a.log: has no frame; candump -l and -L, "),
        ("a.blf", BINARY, "'python3 -m can.logconvert LOG OTHER.log' "),
        ("a.log", b" can0  101   [2]  43 1A\n", "has no frame (line 1: 'can0  101   [2]  43 1A')"),
        ("serial.bin", b"\n" * 200_000, "serial.csv: unreadable (No such file"),
        ("a.log", TWO, "interfaces, can0, can1; keep those of the skin's, as by grep"),
        (".", None, "of a session its frames.log or serial.bin"),
    ],
    ids=["empty", "binary", "another form", "without times", "two interfaces", "a directory"],
)
def test_a_log_that_cannot_be_read_is_refused_with_one_line(
    tmp_path: Path, name: str, content: bytes | None, part: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert part in refused("decode", tmp_path / name)


def test_the_bytes_of_a_recorded_serial_line_are_decoded_with_their_times() -> None:
    *lines, last = decode(RECORDED, of_session(RECORDED))
    times, stats = [json.loads(line)["t"] for line in lines], json.loads(last)["stats"]
    assert (len(times), stats["bytes"]) == (stats["scans"], RECORDED.stat().st_size)
    assert np.diff(times) == pytest.approx(0.05, abs=0.01)
    assert stats["bytes_used"] + stats["bytes_dropped"] == stats["bytes"]
    assert stats["bad_lines"] == 0


def test_a_log_of_any_length_takes_the_same_memory(tmp_path: Path) -> None:
    log, peaks = tmp_path / "frames.log", []
    for scans in (200, 2000):
        candump_log()(bus(scans), log)
        tracemalloc.start()
        assert sum(1 for _ in decode(log)) == scans + 1
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 100_000
