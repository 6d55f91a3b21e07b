"""What `taxeld decode` costs a process in CPU and memory: a log, and one of ten times its length.

A hub of 60 modules that declares them before it streams, and one that never does, for which a log
is read twice.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from protocol import MODULES, scan_frames
from taxeld_protocol import cyskin
from taxeld_protocol.frames import Frame, format_log_line
from taxeld_protocol.modules import encode_details

FRAMES_A_SCAN = 174
LENGTHS = (100_000, 1_000_000)  # frames
CPU_MAX_S, MEMORY_MAX_MB = 8.0, 100.0  # of the longest

DECODE = """
import sys, time
from pathlib import Path
from taxeld.commands.decode import decode
scans = sum(1 for _ in decode(Path(sys.argv[1]))) - 1
peak = Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]
print(scans, time.process_time(), int(peak) / 1024)
"""


def rows() -> list[tuple[str, float, float | None]]:
    """(figure, measured, budget)."""
    found: list[tuple[str, float, float | None]] = []
    with tempfile.TemporaryDirectory() as place:
        log = Path(place) / "log"
        for kind in ("declared", "undeclared"):
            for length in LENGTHS:
                write(log, length, declared=kind == "declared")
                cpu_s, peak_mb = decoded(log, length // FRAMES_A_SCAN)
                limits = (CPU_MAX_S, MEMORY_MAX_MB) if length == LENGTHS[-1] else (None, None)
                name = f"{length:_} frames decoded, {kind}".replace("_", " ")
                found.append((f"{name}: CPU s", cpu_s, limits[0]))
                found.append((f"{name}: MB", peak_mb, limits[1]))
    return found


def write(log: Path, length: int, *, declared: bool) -> None:
    """As `candump -L` writes it."""
    frames: list[Frame] = []
    if declared:
        channels = bytes(module.channels for module in MODULES)
        frames += cyskin.to_frames(0x3C, bytes((len(MODULES), 0)) + channels, ihb=1)
        for i, module in enumerate(MODULES):
            frames += cyskin.to_frames(0x3D, encode_details(i, module), ihb=1)
    scan = scan_frames(1)
    with log.open("w", encoding="ascii") as file:
        file.writelines(format_log_line(frame) + "\n" for frame in frames)
        for k in range(length // FRAMES_A_SCAN):
            file.writelines(
                format_log_line(frame._replace(t=1.7e9 + 0.05 * k + 1.1e-4 * at)) + "\n"
                for at, frame in enumerate(scan)
            )


def decoded(log: Path, scans: int) -> tuple[float, float]:
    """CPU time [s] and peak memory [MB] of a process that decodes it."""
    ran = subprocess.run(
        [sys.executable, "-c", DECODE, str(log)], capture_output=True, text=True, check=True
    )
    found, cpu_s, peak_mb = ran.stdout.split()
    assert int(found) == scans
    return float(cpu_s), float(peak_mb)


if __name__ == "__main__":
    for figure, measured, _ in rows():
        print(f"{figure:60s} {measured:8.2f}")
