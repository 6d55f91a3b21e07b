"""A bus as a log of each kind that `taxeld decode` reads, and what it makes of them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taxeld.commands.decode import decode
from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol.frames import Frame, format_log_line
from taxeld_protocol.modules import Module
from tests.rig.virtual_hub import frames_of, told

MODULES = [Module(12, 0x51, 0xFFF), Module(11, 0x37, 0x7FF)]
CHANNELS = 23
START_S = 1_700_000_000.0
PERIOD_S = 0.05
FRAME_S = 0.00011

Write = Callable[[list[Frame], Path], None]


def values_of(scan: int) -> list[int]:
    """Of all channels."""
    return [1000 * (scan % 40) + k for k in range(CHANNELS)]


def bus(scans: int = 6) -> list[Frame]:
    """A hub that declares its modules, then scans; and frames of other devices between them."""
    hub = VirtualIhb(MODULES)
    others = [Frame(0.0, 0x18DAF110, b"\x01\x02", extended=True), Frame(0.0, 0x7F0, b"")]
    parts = [frames_of(told(hub)) + others]
    parts += [frames_of(hub.sensor_data(values_of(scan))) for scan in range(scans)]
    return [
        frame._replace(t=round(START_S + PERIOD_S * k + FRAME_S * i, 6))
        for k, part in enumerate(parts)
        for i, frame in enumerate(part)
    ]


def counts(scans: int = 6) -> list[list[list[int]]]:
    """Of the scans of `bus`, by module."""
    return [[values_of(scan)[:12], values_of(scan)[12:]] for scan in range(scans)]


def candump_log(interface: str = "can0", end: str = "") -> Write:
    """`candump -L`, or what `-l` writes; `end`: R and T of `-x`."""

    def write(frames: list[Frame], path: Path) -> None:
        lines = [format_log_line(frame, interface) + end + "\n" for frame in frames]
        path.write_text("".join(lines), encoding="ascii")

    return write


WRITERS: dict[str, Write] = {  # by the name of a file
    "candump": candump_log(),
    "candump.log": candump_log(),
    "candump-x.log": candump_log(end=" R"),
}


def written(name: str, directory: Path, scans: int = 6) -> Path:
    """A log of `bus`."""
    WRITERS[name](bus(scans), directory / name)
    return directory / name


def decoded(log: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The scans, and the last line's counters."""
    *scans, last = map(json.loads, decode(log))
    return scans, last["stats"]
