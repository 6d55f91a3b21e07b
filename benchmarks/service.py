"""The daemon as a process: share of a core, delay, start, memory, overruns (stand.py).

python benchmarks/service.py [--seconds 20] [--long MINUTES] [--json FILE]
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from stand import Load, Measured, measure
from taxeld.layout import read as layouts
from taxeld.proposals import bundle

LARGE = "cylinder:rows=5,columns=128,radius_m=0.04,pitch_m=0.015"  # 640 taxels
COUNTS = (1, 10)  # subscribers
Row = tuple[str, float, float | None]  # a figure, measured, and its budget


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="a case of CPU time")
    parser.add_argument("--long", type=float, default=0.0, help="minutes, touched all the time")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = [*rows(args.seconds), *streams(args.seconds), *(long(args.long) if args.long else [])]
    for name, value, budget in found:
        print(f"{name:60s} {value:10.3f} {'' if budget is None else f'{budget:8.2f}'}", flush=True)
    if args.json:
        lines = [dict(zip(("figure", "measured", "budget"), row, strict=True)) for row in found]
        args.json.write_text(json.dumps(lines, indent=1) + "\n", encoding="utf-8")
    return 0


def rows(seconds: float = 20.0) -> list[Row]:
    """The share of a core, the path's time, the start and the memory."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        touched = measure(Load(touched=True), seconds, place)
        idle = measure(Load(touched=False), seconds, place)
        alone = measure(Load(touched=True, alone=True), seconds, place)
        idle_alone = measure(Load(touched=False, alone=True), seconds, place)
        recording = measure(Load(touched=False, record=True), seconds, place)
        large = str(large_bundle(place / "large"))
        wide = measure(Load(touched=True, layout=LARGE, bundle=large), seconds, place)
    return [
        ("a core's share, 80 taxels, touched all the time: %", touched.cpu_percent, 6.0),
        ("  … scans with contact that were learned from, a second", touched.updates_hz, None),
        ("a core's share, untouched: %", idle.cpu_percent, 2.0),
        ("  … without an object: %", idle_alone.cpu_percent, None),
        ("  … and touched all the time: %", alone.cpu_percent, None),
        ("  … start to ready: CPU s", idle_alone.start_cpu_s, None),
        ("  … resident memory: MB", alone.resident_mb, None),
        ("  … with it, recorded: %", recording.cpu_percent, None),
        ("a core's share, 640 taxels, touched all the time: %", wide.cpu_percent, 10.0),
        ("a scan's way through the loop, median: ms", touched.lat_us["p50"] / 1e3, 2.0),
        ("a scan's way through the loop, 99 %: ms", touched.lat_us["p99"] / 1e3, 5.0),
        *_reached("untouched", idle),
        *_reached("touched", touched),
        ("  … of scans that brought samples, median: ms", _percentile(touched.sampled_ms), None),
        ("start to ready: CPU s", idle.start_cpu_s, 0.5),
        ("resident memory: MB", touched.resident_mb, 90.0),
    ]


def long(minutes: float) -> list[Row]:
    """Touched all the time; beside it what the machine does to any such loop."""
    with tempfile.TemporaryDirectory() as place:
        ran = measure(Load(touched=True), 60.0 * minutes, Path(place))
    found: list[Row] = [
        (f"{minutes:g} minutes: overruns of its own", ran.own_overruns, 0.0),
        ("  … periods missed, for whatever reason", ran.overruns, None),
        ("  … a scan's way, 99 %: ms", ran.lat_us["p99"] / 1e3, 5.0),
        ("  … and longest: ms", ran.lat_us["max"] / 1e3, None),
        ("  … growth of resident memory: MB", ran.grown_mb, 1.0),
    ]
    if shutil.which("cyclictest"):
        with tempfile.TemporaryDirectory() as place:
            out = Path(place) / "cyclictest.json"
            command = ["cyclictest", "-q", "-p", "20", "-i", "5000", "-D", "60", "--json", str(out)]
            done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
            if done.returncode == 0:
                thread = json.loads(out.read_text(encoding="utf-8"))["thread"]["0"]
                found.append(("  … cyclictest's longest delay here: ms", thread["max"] / 1e3, None))
    return found


def streams(seconds: float = 10.0) -> list[Row]:
    """From a scan's last frame to its estimate, and the share of a core of all the daemon's
    processes, of an untouched skin."""
    found: list[Row] = []
    with tempfile.TemporaryDirectory() as place:
        for count in COUNTS:
            ran = measure(Load(touched=False, subscribers=count), seconds, Path(place))
            to = f"to {count} subscriber{'s' * (count > 1)}"
            found += [
                (f"a scan's last frame {to}, median: ms", float(np.median(ran.reached_ms)), None),
                ("  … to the last, 99 %: ms", float(np.percentile(ran.last_ms, 99)), None),
                (f"a core's share, untouched, {to}: %", ran.cpu_percent, None),
            ]
    return found


def _reached(case: str, ran: Measured) -> list[Row]:
    named = f"a scan's last frame to its estimate, {case}"
    return [
        (f"{named}, median: ms", _percentile(ran.reached_ms), 1.5),
        (f"{named}, 99 %: ms", _percentile(ran.reached_ms, 99.0), 5.0),
    ]


def _percentile(found: np.ndarray, share: float = 50.0) -> float:
    return float(np.percentile(found, share)) if len(found) else 0.0


def large_bundle(path: Path, layout: str = LARGE) -> Path:
    """The shipped box for a skin of as many rows but more columns: by the table, as its samplers
    are of their own skin."""
    shutil.copytree(bundle.find("box"), path)
    info = json.loads((path / "bundle.json").read_text(encoding="utf-8"))
    large = layouts.load(layout)
    info["layout"] = {**info["layout"], "name": large.name, "digest": large.digest}
    info["samplers"], info["auto"] = [], ["table"]
    (path / "bundle.json").write_text(json.dumps(info), encoding="utf-8")
    return path


if __name__ == "__main__":
    sys.exit(main())
