"""The daemon as a process: share of a core, delay, start, memory, overruns (stand.py).

    python benchmarks/service.py [--seconds 40] [--beside CHECKOUT]

With `--beside` another checkout's daemon runs at the same time, and figures have their ratio to
its own, with an interval of 95 % over windows of four seconds or over scans.
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stand import Load, Measured, measure
from taxeld.layout import read as layouts
from taxeld.proposals import bundle

HERE = Path(__file__).parents[1]
SECONDS = 40.0  # of CPU time a case
LARGE = "cylinder:rows=5,columns=128,radius_m=0.04,pitch_m=0.015"  # 640 taxels
Row = tuple[str, float, float | None]  # a figure, measured, and its budget
Figure = tuple[str, float | None, Callable[[Measured], Any]]  # name, budget, its values
USUAL: list[Figure] = [
    ("a core's share: %", 2.0, lambda ran: ran.cpu_percent),
    ("last frame to subscriber, median: ms", 1.5, lambda ran: ran.reached_ms),
]
START: list[Figure] = [
    ("start to ready: CPU s", 0.5, lambda ran: [ran.start_cpu_s]),
    ("resident memory: MB", 100.0, lambda ran: ran.resident_mb[-1:]),
]
LOOP: list[Figure] = [
    ("a scan's way, 99 %: us", 5000.0, lambda ran: [ran.health["lat_us"]["total"]["p99"]]),
    ("growth of resident memory: MB", 1.0, lambda ran: [np.ptp(ran.resident_mb)]),
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="a case of CPU time")
    parser.add_argument("--beside", type=Path, help="another checkout, for ratios")
    args = parser.parse_args()
    show(rows(args.seconds, args.beside))


def show(found: Iterable[Row]) -> None:
    """Print each figure as it comes."""
    for name, value, budget in found:
        print(f"{name:72s} {value:12.3f} {'' if budget is None else f'{budget:10.2f}'}", flush=True)


def rows(seconds: float, beside: Path | None = None) -> Iterator[Row]:
    """All figures, each case's after it has run."""
    with tempfile.TemporaryDirectory() as name:
        wide = Load(touched=True, layout=LARGE, bundle=str(large_bundle(Path(name) / "large")))
        for case, what, figures in (
            (Load(touched=False), "untouched", [*USUAL, *START]),
            (Load(touched=True), "touched all the time", [*USUAL, *LOOP]),
            (wide, "640 taxels, touched all the time", USUAL[:1]),
        ):
            ours, *theirs = measure(case, seconds, [HERE, *([beside] if beside else [])])
            for figure, budget, values in figures:
                yield f"{what}: {figure}", float(np.median(values(ours))), budget
                for other in theirs:
                    middle, low, high = ratio(values(ours), values(other))
                    yield f"  … over that beside it, {low:.2f} to {high:.2f}", middle, None


def ratio(ours: Any, theirs: Any) -> tuple[float, float, float]:
    """Of the medians, and its interval by resampling; windows are drawn in pairs."""
    one, other, rng = np.asarray(ours), np.asarray(theirs), np.random.default_rng(0)
    drawn = []
    for _ in range(2000):
        at = rng.integers(len(one), size=len(one))
        to = at if len(one) == len(other) else rng.integers(len(other), size=len(other))
        drawn.append(np.median(one[at]) / np.median(other[to]))
    low, high = np.percentile(drawn, (2.5, 97.5)).tolist()
    return float(np.median(one) / np.median(other)), low, high


def large_bundle(path: Path) -> Path:
    """The shipped box for a skin of as many rows but more columns: by the table, as its samplers
    are of their own skin."""
    shutil.copytree(bundle.find("box"), path)
    info, large = json.loads((path / "bundle.json").read_text()), layouts.load(LARGE)
    info["layout"] = {**info["layout"], "name": large.name, "digest": large.digest}
    info["samplers"], info["auto"] = [], ["table"]
    (path / "bundle.json").write_text(json.dumps(info))
    return path


if __name__ == "__main__":
    main()
