"""A bus as a log of each kind that `taxeld decode` reads, and what it makes of them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taxeld.commands.decode import decode
from taxeld_hil.rig.virtual_ihb import VirtualIhb, details
from taxeld_protocol import cyskin
from taxeld_protocol.frames import Frame, format_log_line
from taxeld_protocol.modules import Module
from tests.rig.virtual_hub import frames_of

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
        (cyskin.Command.MODULE_DETAILS, details(i, module)) for i, module in enumerate(MODULES)
    ]
    frames += frames_of(packets)
    frames.append(Frame(0.0, 0x18DAF110, b"\x01\x02", extended=True))
    frames.append(Frame(0.0, 0x7F0, b""))
    t, stamped = 0.0, list[Frame]()
    for frame in frames:
        stamped.append(frame._replace(t=START_S + t))
        t += FRAME_S
    for scan in range(scans):
        t = (scan + 1) * PERIOD_S
        for frame in frames_of(hub.sensor_data(values_of(scan))):
            stamped.append(frame._replace(t=round(START_S + t, 6)))
            t += FRAME_S
    return stamped


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
