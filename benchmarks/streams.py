"""What subscribers cost: delay and CPU time for 1 and 10 of them, each of all topics (stand.py).

python benchmarks/streams.py [SECONDS]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from stand import Case, measure

COUNTS = (1, 10)
Row = tuple[str, float, float | None]  # a figure, measured, and its budget


def rows(seconds: float = 10.0) -> list[Row]:
    """From a scan's last frame to its estimate, and the share of a core of all the daemon's
    processes, of an untouched skin."""
    found: list[Row] = []
    with tempfile.TemporaryDirectory() as place:
        for count in COUNTS:
            ran = measure(Case(touched=False, subscribers=count), seconds, Path(place))
            to = f"to {count} subscriber{'s' * (count > 1)}"
            found += [
                (f"a scan's last frame {to}, median: ms", float(np.median(ran.reached_ms)), None),
                ("  … to the last, 99 %: ms", float(np.percentile(ran.last_ms, 99)), None),
                (f"a core's share, untouched, {to}: %", ran.cpu_percent, None),
            ]
    return found


if __name__ == "__main__":
    for figure, measured, _ in rows(*map(float, sys.argv[1:])):
        print(f"{figure:60s} {measured:10.3f}")
