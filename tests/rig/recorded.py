"""A recorded session: an idle skin that is then touched, as frames of a candump log."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from taxeld_protocol import cyskin
from taxeld_protocol.frames import format_log_line
from taxeld_protocol.virtual_ihb import Answer, VirtualIhb
from tests.rig.configurations import Table
from tests.rig.configurations import configuration as of_daemon
from tests.rig.skins import CHANNELS, MODULES
from tests.rig.virtual_hub import told

from ..firmware_protocol.test_cyskin import GOLDEN_SCAN

PERIOD_S = 0.05
IDLE_SCANS = 25  # the baseline takes 20
IDLE_COUNTS, NOISE = 1000, 30.0
PRESSED = range(36, 44)  # channels of one side of the skin
DEAD = 5  # a channel that never reads anything


def write_session(place: Path, touches: int = 1, period_s: float = PERIOD_S, rest: int = 0) -> None:
    """`frames.log` in `place`: idle, then `touches` times ten scans of touch and ten of none, and
    `rest` more of none, after what the hub told of its modules."""
    rng = np.random.default_rng(0)
    ihb = VirtualIhb(MODULES)
    lines: list[str] = []

    def log(answers: Iterable[Answer], t: float) -> None:
        for command, payload in answers:
            frames = cyskin.to_frames(command, payload, ihb=ihb.short_id, t=t)
            lines.extend(map(format_log_line, frames))

    log(told(ihb), 1e9)
    for scan in range(IDLE_SCANS + 20 * touches + rest):
        t = 1e9 + scan * period_s
        counts = IDLE_COUNTS + rng.normal(0.0, NOISE, CHANNELS)
        is_touched = 0 <= scan - IDLE_SCANS < 20 * touches
        if is_touched and (scan - IDLE_SCANS) % 20 < 10:
            counts[PRESSED] += 8000.0
        counts[DEAD] = 0.0
        log(ihb.sensor_data(counts.astype(int).tolist()), t)
    (place / "frames.log").write_text("\n".join(lines) + "\n", encoding="ascii")


def write_golden(place: Path) -> None:
    """`frames.log` in `place`: the documented scan of one module, which does not tell its name."""
    lines = [f"(1.000000) can0 {line}" for line in GOLDEN_SCAN]
    (place / "frames.log").write_text("\n".join(lines) + "\n", encoding="ascii")


def golden(place: Path, **tables: Table) -> Path:
    """The configuration of a daemon that replays `write_golden` and serves nobody; `tables`: more
    keys."""
    whole: dict[str, Table] = {
        "source": {"kind": "replay", "path": place, "modules": [[1, 0xFFF]]},
        "publish": {"endpoints": []},
        "control": {"endpoint": ""},
    }
    more = {name: {**whole.get(name, {}), **keys} for name, keys in tables.items()}
    return of_daemon(place, **whole | more)


def configuration(place: Path, more: str = "") -> Path:
    """Of a daemon that replays `place` and serves there; `more`: tables."""
    path = of_daemon(place)
    path.write_text(path.read_text(encoding="utf-8") + more, encoding="utf-8")
    return path
