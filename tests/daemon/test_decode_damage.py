"""Damaged logs: what is whole is decoded, the rest counted and named once; memory stays small."""

import gzip
import sqlite3
import struct
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from taxeld.errors import SetupError

from .log_writers import (
    BEFORE_SCANS,
    WRITERS,
    bus,
    candump_log,
    counts,
    decoded,
    frames_of,
    said,
    sqlite,
)

FRAMES = bus()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A file whose name tells nothing."""
    return tmp_path / "recording"


# A frame that carries nothing for a skin, and one that is damaged, as each text format has them
LINES = {
    "candump -L -t a": (
        ["(1700000000.1) can0 101#R", "(1700000000.1) can0 101#R8_9", "(1700000000.1) can0 "
         "20000088#0000000000000000", "(1700000000.1) can0 101##1001122 R",
         "(1700000000.1) can0 00123#81:00:12345678#11223344"],
        ["(1700000000.1) can0 101#4", "(1700000000.1) can0 1G1#43", "(1700000000.1) can0 8FF#43",
         "(17000", "DROPCOUNT: dropped 3 CAN frames on 'can0' socket (total drops 3)",
         f"({'9' * 400}.5) can0 101#43"],
    ),
    "candump -t A": (
        [" (2023-11-14 22:13:20.1)  can0  101   [8]  remote request",
         " (2023-11-14 22:13:20.1)  can0  20000088   [8]  00 00 80 19 00 00 00 00   ERRORFRAME",
         " (2023-11-14 22:13:20.1)  can0       101  [12]  00 11 22 33 44 55 66 77 88 99 AA BB"],
        [" (2023-11-14 22:13:20.1)  can0  101   [3]  43 1A",
         " (2023-13-14 22:13:20.1)  can0  101   [2]  43 1A",
         " (2023-11-14 22:13:20.1)  can0  101   [2]  43 1"],
    ),
    "asc": (
        ["   0.1 1  101             Rx   r", "   0.1 1  ErrorFrame  Flags = 0x2",
         "   0.1 CANFD   1 Rx        101        1 0 9 12 00 11 22 33 44 55 66 77 88 99 AA BB 0"],
        ["   0.1 1  101             Rx   d 2 43", "   0.1 1  101             Rx   d 2 43 1G",
         "   0.1 1  1G1             Rx   d 1 43", f"   {'9' * 400}.1 1  101  Rx   d 1 43"],
    ),
    "trc 1.1": (
        ["    99)        50.1  Rx         0101  3  RTR", "    99)        50.1  Error      0008  4  "
         "00 19 08 08"],
        ["    99)        50.1  Rx         0101  3  43 1A",
         "    99)        50.1  Rx         01G1  1  43",
         f"    99)        {'9' * 400}  Rx     0101  1  43"],
    ),
    "trc 2.1": (
        ["     99        50.100 RR  1     0101 Rx -  3", "     99     50.100 FD  1  0101 Rx -  9  "
         "00 11 22 33 44 55 66 77 88 99 AA BB"],
        ["     99        50.100 DT  1     0101 Rx -  3    43 1A",
         "     99        50.100 DT  1     0101 Rx -  1    FD FD"],
    ),
    "csv by python-can": (
        ["1700000000.1,0x101,0,1,0,3,", "1700000000.1,0x0,1,0,1,0,",
         "1700000000.1,0x101,0,0,0,12,AAAAAAAAAAAAAAAA"],
        ["1700000000.1,0x101,0", "1700000000.1,0x101,0,0,0,2,AA==",
         "1700000000.1,0x801,0,0,0,1,AA==",
         f"{'9' * 400}.1,0x101,0,0,0,1,AA=="],
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "line"), [(kind, line) for kind, (lines, _) in LINES.items() for line in lines]
)
def test_a_frame_that_carries_nothing_for_a_skin_is_counted_as_foreign(
    log: Path, kind: str, line: str
) -> None:
    WRITERS[kind](FRAMES, log)
    log.write_text(log.read_text(encoding="ascii") + line + "\n", encoding="ascii")
    found, damage = frames_of(log)
    assert (len(found), found[-1], damage.count) == (len(FRAMES) + 1, None, 0)
    assert decoded(log)[1]["dropped"]["foreign"] == 3  # type: ignore[index]


@pytest.mark.parametrize(
    ("kind", "line"), [(kind, line) for kind, (_, lines) in LINES.items() for line in lines]
)
def test_a_damaged_line_costs_itself_alone_and_is_counted_and_named_once(
    log: Path, caplog: pytest.LogCaptureFixture, kind: str, line: str
) -> None:
    WRITERS[kind](FRAMES, log)
    lines = log.read_text(encoding="ascii").split("\n")
    at = len(lines) // 2
    lines[at:at] = [line, line]
    log.write_text("\n".join(lines), encoding="ascii")
    scans, stats = decoded(log)
    assert [scan["modules"] for scan in scans] == counts()
    assert (stats["frames"], stats["bad_lines"]) == (len(FRAMES), 2)
    (message,) = caplog.messages
    assert f"2 bad_lines), at first line {at + 1}: '{line.strip()[:40]}" in message
    assert "\n" not in message


def test_the_lines_that_explain_an_error_frame_are_no_damage(log: Path) -> None:
    WRITERS["candump -t a"](FRAMES, log)
    text = log.read_text(encoding="ascii")
    log.write_text(text + "\tcontroller-problem{tx-error-warning}\n", encoding="ascii")
    assert frames_of(log)[1].count == 0


@pytest.mark.parametrize(
    ("change", "bad", "part"),
    [
        (lambda _: None, 1, "serial.csv: 'it is not there"),
        (lambda rows: ["t,offset", f"{'9' * 400},0", *rows[2:]], 1, "serial.csv line 2: '999"),
        (lambda rows: [*rows[:4], "nan,5", "1700000000.5,1", *rows[4:]], 2, "line 5: 'nan,5'"),
        (lambda rows: rows[: len(rows) // 2], 0, ""),
    ],
    ids=["none", "400 digits", "no rows", "cut"],
)
def test_bytes_whose_times_are_damaged_are_decoded_all_the_same(
    tmp_path: Path, caplog: pytest.LogCaptureFixture,
    change: Callable[[list[str]], list[str] | None], bad: int, part: str,
) -> None:  # fmt: skip
    recorded = Path(__file__).parent / "session"
    whole, _ = decoded(recorded / "serial.bin")
    log = tmp_path / "serial.bin"
    log.write_bytes((recorded / "serial.bin").read_bytes())
    rows = change((recorded / "serial.csv").read_text(encoding="ascii").split("\n"))
    if rows is not None:
        log.with_suffix(".csv").write_text("\n".join(rows), encoding="ascii")
    scans, stats = decoded(log)
    assert [scan["modules"] for scan in scans] == [scan["modules"] for scan in whole]
    assert stats["bad_lines"] == bad
    assert part in "".join(caplog.messages)


def test_what_is_packed_is_read_up_to_where_it_is_cut_or_damaged(
    log: Path, caplog: pytest.LogCaptureFixture
) -> None:
    candump_log("a")(bus(3000), log)
    packed = gzip.compress(log.read_bytes())
    for damaged in (packed[: len(packed) // 2], packed[: len(packed) // 2] + bytes(1000)):
        caplog.clear()
        log.write_bytes(damaged)
        scans, stats = decoded(log)
        assert 1000 < len(scans) < 2000
        assert stats["bad_lines"] >= 1
        assert len(caplog.messages) == 1


@pytest.mark.parametrize(
    ("content", "cure"),
    [
        (b"", "has no frame; logs of candump, asc"),
        (b"\n" * 200_000, "has no frame"),
        (b"MDF     4.10    ", "is an MF4 measurement; convert it"),
        (b"BZh91AY&SY", "is packed with bzip2; unpack it first"),
        (b"LOGG", "has no frame; byte 0: 'a header that is cut'"),
        (b"SQLite format 3\0" + bytes(100), "has no frame; row 1: "),
        (gzip.compress(b""), "has no frame"),
        (b"\x1f\x8b\x08\0\0", "has no frame"),
    ],
)
def test_what_is_no_log_is_refused_with_a_cure(
    log: Path, capsys: pytest.CaptureFixture[str], content: bytes, cure: str
) -> None:
    log.write_bytes(content)
    assert cure in said(log, capsys)


def test_a_directory_is_no_log_and_the_line_says_what_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "name its frames.log or serial.bin" in said(tmp_path, capsys)


def test_a_database_of_something_else_is_refused(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sqlite(FRAMES, log)
    log.write_bytes(log.read_bytes().replace(b"messages", b"passages"))
    assert "there is no table 'messages'" in said(log, capsys)


MEMORY = """
import sys
from pathlib import Path
from taxeld.commands.decode import decode
lines = sum(1 for _ in decode(Path(sys.argv[1])))
status = Path("/proc/self/status").read_text()
print(lines, status.split("VmHWM:")[1].split()[0])
"""


@pytest.mark.parametrize("declared", [True, False], ids=["declared", "undeclared"])
def test_a_log_of_any_length_takes_the_same_memory(log: Path, declared: bool) -> None:
    """The peak of a process, in kB, over a log and over one of ten times its length."""
    peaks = []
    for scans in (1000, 10_000):
        frames = bus(scans)
        candump_log("a")(frames if declared else frames[BEFORE_SCANS:], log)
        ran = subprocess.run(
            [sys.executable, "-c", MEMORY, str(log)], capture_output=True, text=True, check=True
        )
        lines, peak = map(int, ran.stdout.split())
        assert lines == scans + 1
        peaks.append(peak)
    assert peaks[1] < peaks[0] + 4000
    assert peaks[1] < 100_000


BLF_HEAD = b"LOGG" + struct.pack("<L", 144) + bytes(136)


def blf_object(content: bytes, kind: int, size: int | None = None) -> bytes:
    """An object of a blf file, or what says it is one of that size."""
    whole = 16 + len(content)
    return struct.pack("<4sHHLL", b"LOBJ", 16, 1, whole if size is None else size, kind) + content


def blf_frame(data: bytes, *, can_id: int = 0x101, length: int | None = None) -> bytes:
    content = struct.pack("<L4xQHBBL8s", 2, 0, 1, 0, len(data) if length is None else length,
                          can_id, data)  # fmt: skip
    return blf_object(content, 1)


def blf_container(content: bytes, packing: int = 2) -> bytes:
    packed = zlib.compress(content) if packing == 2 else content
    made = blf_object(struct.pack("<H6xL4x", packing, len(content)) + packed, 10)
    return made + bytes(len(made) % 4)


@pytest.mark.parametrize(
    "damaged",
    [
        blf_container(blf_object(bytes(16), 5, size=0), packing=0),
        blf_container(blf_object(bytes(16), 1, size=17)),
        blf_container(blf_object(bytes(16), 1, size=0xFFFF_FFFF)),
        blf_container(b"noise" * 9),
        blf_container(blf_object(bytes(20), 1)),
        blf_container(blf_frame(b"1", can_id=0x801)),
        blf_container(blf_frame(b"1", length=200)),
        blf_container(b"", packing=7),
        blf_container(blf_frame(b"1"))[:40] + bytes(20),
        blf_object(b"", 10),
        b"LOBJ" * 20,
        bytes(100_000),
    ],
    ids=range(12),
)
def test_a_damaged_part_of_a_blf_file_ends_and_costs_itself_alone(
    log: Path, damaged: bytes
) -> None:
    """An object of no length keeps python-can's reader busy for ever."""
    before, after = (blf_container(blf_frame(data) * 5) for data in (b"before", b"after"))
    log.write_bytes(BLF_HEAD + before + damaged + after)
    found, damage = frames_of(log)
    data = [frame.data for frame in found if frame]
    assert data[:5] == [b"before"] * 5
    assert data[-5:] == [b"after"] * 5
    assert len(data) == 10
    assert damage.count >= 1


def test_objects_of_a_blf_file_run_over_containers(log: Path) -> None:
    objects = b"".join(blf_frame(bytes([k])) + bytes(k % 4) for k in range(50))
    pieces = [objects[at : at + 37] for at in range(0, len(objects), 37)]
    log.write_bytes(BLF_HEAD + b"".join(map(blf_container, pieces)))
    found, damage = frames_of(log)
    assert [frame.data for frame in found if frame] == [bytes([k]) for k in range(50)]
    assert damage.count == 0


def test_other_frames_of_a_blf_file_are_foreign(log: Path) -> None:
    others = b"".join(blf_object(bytes(40), kind) for kind in (2, 73, 100, 101))
    log.write_bytes(BLF_HEAD + blf_container(others + blf_frame(b"1")))
    assert [frame is None for frame in frames_of(log)[0]] == [True] * 4 + [False]


BOMBS: dict[str, tuple[Callable[[], bytes], int]] = {
    "a line without an end": (lambda: gzip.compress(b"x" * (20 << 20)), 4 << 20),
    "an empty log": (lambda: gzip.compress(b"\n" * (1 << 20)), 4 << 20),
    "a container": (lambda: BLF_HEAD + blf_container(bytes(200 << 20)), 40 << 20),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_what_unpacks_to_much_takes_little_memory(log: Path, kind: str) -> None:
    make, most = BOMBS[kind]
    log.write_bytes(make())
    tracemalloc.start()
    try:
        with pytest.raises(SetupError, match="has no frame"):
            decoded(log)
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "values",
    [("text", 257, 0, 0, 0, 1, b"1"), (float("inf"), 257, 0, 0, 0, 1, b"1"),
     (1.0, "x", 0, 0, 0, 1, b"1"), (1.0, 2048, 0, 0, 0, 1, b"1"), (1.0, -1, 1, 0, 0, 1, b"1"),
     (1.0, 257, 0, 0, 0, 1, 7)],
)  # fmt: skip
def test_a_row_that_is_no_frame_costs_itself_alone(log: Path, values: tuple[object, ...]) -> None:
    sqlite(FRAMES, log)
    base = sqlite3.connect(log)
    base.execute("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)", values)
    base.execute("INSERT INTO messages VALUES (1.0, 257, 0, 0, 0, 0, NULL)")
    base.execute("INSERT INTO messages VALUES (1.0, 257, 0, 1, 0, 0, NULL)")
    base.execute("INSERT INTO messages VALUES (1.0, 257, 0, 0, 0, 12, ?)", [bytes(12)])
    base.commit()
    base.close()
    found, damage = frames_of(log)
    assert damage.count == 1
    assert damage.first.startswith(f"row {len(FRAMES) + 1}: ")
    assert [frame and frame.data for frame in found[len(FRAMES) :]] == [b"", None, None]
