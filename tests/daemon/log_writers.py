"""A bus as logs of every kind that `taxeld decode` reads, and what it makes of them."""

import json
import sqlite3
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

import can
import pytest

from taxeld.cli import main
from taxeld.commands.decode import decode
from taxeld.source.logs.files import LogFile
from taxeld.source.logs.text import Damage
from taxeld_protocol import cyskin
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import Module, encode_details
from taxeld_protocol.virtual_ihb import VirtualIhb

MODULES = [Module(12, 0x51, 0xFFF), Module(11, 0x37, 0x7FF)]
CHANNELS = 23
START_S = 1_700_000_000.0
PERIOD_S = 0.05
BEFORE_SCANS = 7  # frames of `bus` before the first scan
FRAME_S = 0.00011

Write = Callable[[list[Frame], Path], None]


def values_of(scan: int) -> list[int]:
    """Of all channels."""
    return [1000 * (scan % 40) + k for k in range(CHANNELS)]


def bus(scans: int = 6) -> list[Frame]:
    """A hub that declares its modules, then scans; and frames of other devices between them."""
    hub, frames = VirtualIhb(MODULES), list[Frame]()
    packets = [(cyskin.Command.DECLARE, bytes((2, 0, 12, 11)))]
    packets += [
        (cyskin.Command.MODULE_DETAILS, encode_details(i, module))
        for i, module in enumerate(MODULES)
    ]
    for command, payload in packets:
        frames += cyskin.to_frames(command, payload, ihb=1)
    frames.append(Frame(0.0, 0x18DAF110, b"\x01\x02", extended=True))
    frames.append(Frame(0.0, 0x7F0, b""))
    t, stamped = 0.0, list[Frame]()
    for frame in frames:
        stamped.append(frame._replace(t=START_S + t))
        t += FRAME_S
    for scan in range(scans):
        t = (scan + 1) * PERIOD_S
        for command, payload in hub.sensor_data(values_of(scan)):
            for frame in cyskin.to_frames(command, payload, ihb=1):
                stamped.append(frame._replace(t=round(START_S + t, 6)))
                t += FRAME_S
    return stamped


def counts(scans: int = 6) -> list[list[list[int]]]:
    """Of the scans of `bus`, by module."""
    return [[values_of(scan)[:12], values_of(scan)[12:]] for scan in range(scans)]


def _id(frame: Frame) -> str:
    return f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"


def _stamps(frames: list[Frame], kind: str) -> Iterator[str]:
    """As candump's `sprint_timestamp` writes them."""
    last = frames[0].t
    for frame in frames:
        if kind == "a":
            yield f"({frame.t:017.6f}) "
        elif kind == "A":
            yield f"({datetime.fromtimestamp(frame.t):%Y-%m-%d %H:%M:%S.%f}) "
        elif kind:
            yield f"({frame.t - last:010.6f}) "
            last = frame.t if kind == "d" else last
        else:
            yield ""


def candump_log(kind: str, interface: str = "can0", end: str = "") -> Write:
    """`candump -L`, or what `-l` writes; `end`: R and T of `-x`."""

    def write(frames: list[Frame], path: Path) -> None:
        lines = [
            f"{stamp}{interface} {_id(frame)}#{frame.data.hex().upper()}{end}\n"
            for frame, stamp in zip(frames, _stamps(frames, kind), strict=True)
        ]
        path.write_text("".join(lines), encoding="ascii")

    return write


def candump_screen(kind: str, *, extra: bool = False, colour: bool = False) -> Write:
    """candump on a terminal; `extra`: with `-x`, `-8` and `-a`."""

    def write(frames: list[Frame], path: Path) -> None:
        lines = []
        for frame, stamp in zip(frames, _stamps(frames, kind), strict=True):
            wide, data = f"{_id(frame):>8}", " ".join(f"{byte:02X}" for byte in frame.data)
            size, text = f"[{len(frame.data)}]", ""
            if extra:
                size = f"{{{len(frame.data)}}}"
                text = " " * (25 - len(data)) + "   'C.\".. x'"
            line = f" {stamp} can0{'  RX - -' if extra else ''}  {wide}   {size}  {data}{text}"
            lines.append(f"\x1b[1m\x1b[31m{line}\x1b[0m\n" if colour else line + "\n")
        path.write_text("".join(lines), encoding="ascii")

    return write


def _message(frame: Frame) -> can.Message:
    return can.Message(
        timestamp=frame.t, arbitration_id=frame.can_id, is_extended_id=frame.extended,
        data=frame.data, channel=0,
    )  # fmt: skip


def python_can(ending: str) -> Write:
    """What python-can's own writer makes."""

    def write(frames: list[Frame], path: Path) -> None:
        made = path.with_name(f"made.{ending}")
        with can.Logger(made) as log:
            for frame in frames:
                log.on_message_received(_message(frame))
        made.rename(path)

    return write


def trc_1_0(frames: list[Frame], path: Path) -> None:
    """By python-can. It has no time of its start, and whole milliseconds."""
    with can.TRCWriter(path.open("w")) as log:
        log.file_version = can.TRCFileVersion.V1_0
        for frame in frames:
            log.on_message_received(_message(frame))


def trc(version: str, columns: str, head: str = "") -> Write:
    """As PEAK's format description has them."""

    def write(frames: list[Frame], path: Path) -> None:
        lines = [f";$FILEVERSION={version}", ";$STARTTIME=45244.92592592593", head, ";"]
        for n, frame in enumerate(frames, 1):
            cells = {
                "N": f"{n:7}" if version[0] == "2" else f"{n:6})",
                "O": f"{1000.0 * (frame.t - START_S):13.3f}",
                "T": "DT",
                "B": "1",
                "d": "Rx",
                "I": f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:04X}",
                "R": "- ",
                "L": str(len(frame.data)),
                "D": frame.data.hex(" ").upper(),
            }
            lines.append(" ".join(cells[column] for column in columns))
        path.write_text("\r\n".join(lines) + "\r\n", encoding="ascii")

    return write


def asc(base: str = "hex", times: str = "absolute") -> Write:
    """As Vector's tools write them, with their events."""

    def write(frames: list[Frame], path: Path) -> None:
        lines = [
            "date Tue Nov 14 10:13:20.000 pm 2023",
            f"base {base}  timestamps {times}",
            "no internal events logged",
            "// version 9.0.0",
            "   0.000000 Start of measurement",
        ]
        last = START_S
        for frame in frames:
            t = frame.t - last
            last = frame.t if times == "relative" else last
            number = f"{frame.can_id:X}" if base == "hex" else f"{frame.can_id}"
            data = frame.data.hex(" ") if base == "hex" else " ".join(map(str, frame.data))
            name = number + ("x" if frame.extended else "")
            lines.append(
                f"   {t:.6f} 1  {name:15} Rx   d {len(frame.data)} {data}"
                "  Length = 244000 BitCount = 126 ID = 257"
            )
            lines.append(f"   {0.0 if times == 'relative' else t:.6f} 1  Statistic: D 1 R 0")
        path.write_text("\n".join([*lines, "End TriggerBlock"]) + "\n", encoding="ascii")

    return write


def sqlite(frames: list[Frame], path: Path) -> None:
    """The table that python-can's writer makes, which it fills from a thread of its own."""
    base = sqlite3.connect(path)
    base.execute(
        "CREATE TABLE messages (ts REAL, arbitration_id INTEGER, extended INTEGER, "
        "remote INTEGER, error INTEGER, dlc INTEGER, data BLOB)"
    )
    base.executemany(
        "INSERT INTO messages VALUES (?, ?, ?, 0, 0, ?, ?)",
        [(f.t, f.can_id, f.extended, len(f.data), f.data) for f in frames],
    )
    base.commit()
    base.close()


WRITERS: dict[str, Write] = {
    **{f"candump -L -t {kind}": candump_log(kind) for kind in "aAdz"},
    "candump -l -x": candump_log("a", end=" R"),
    **{f"candump -t {kind}": candump_screen(kind) for kind in "aAdz"},
    "candump": candump_screen(""),
    "candump -x -8 -a -t d": candump_screen("d", extra=True),
    "candump -c -t z": candump_screen("z", colour=True),
    "candump log by python-can": python_can("log"),
    "asc": asc(),
    "asc, decimal": asc("dec"),
    "asc, differences": asc(times="relative"),
    "asc by python-can": python_can("asc"),
    "trc 1.0": trc_1_0,
    "trc 1.1": trc("1.1", "NOdILD"),
    "trc 1.2": trc("1.2", "NOBdILD"),
    "trc 1.3": trc("1.3", "NOBdIRLD"),
    "trc 2.0": trc("2.0", "NOTIdLD", ";$COLUMNS=N,O,T,I,d,l,D"),
    "trc 2.1": trc("2.1", "NOTBIdRLD", ";$COLUMNS=N,O,T,B,I,d,R,L,D"),
    "trc by python-can": python_can("trc"),
    "csv by python-can": python_can("csv"),
    "blf by python-can": python_can("blf"),
    "SQLite": sqlite,
}
UNTIMED = {"candump"}
MILLISECONDS = {"trc 1.0"}


def frames_of(log: Path) -> tuple[list[Frame | None], Damage]:
    """What a log has, None for frames that carry nothing for a skin, and what of it is damaged."""
    damage = Damage()
    with LogFile(log) as file:
        return [frame for batch in file.frames(damage) for _, frame in batch], damage


def decoded(log: Path, interface: str = "") -> tuple[list[dict[str, object]], dict[str, int]]:
    *scans, last = map(json.loads, decode(log, interface=interface))
    return scans, last["stats"]


def said(log: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line that refuses it."""
    assert main(["decode", str(log), *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    return err
