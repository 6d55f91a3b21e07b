"""How long a session takes to be seen: from the start of `taxeld view` to the first picture, and to
the last.

    python benchmarks/opening.py [--minutes 10] [--runs 3] [--window]

The session is the demo's, with as many touches as the minutes take. `--save` writes a file; with
`--window` it is Rerun's own window on the screen that there is, its start included.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import streams
from taxeld.source import session

CONTACT_S = 3.55  # of the demo's robot, all told
BUDGET_S = 5.0
TIMED = """
import sys, time
from taxeld.cli import main
from taxeld.view.space import Space
flush = Space.flush
def timed(space):
    flush(space)
    space._stream.flush()
    print("drawn", time.monotonic(), flush=True)
Space.flush = timed
sys.exit(main(sys.argv[1:]))
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--window", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) / "session"
        seconds = make(place, args.minutes)
        print(f"a session of {seconds / 60.0:.1f} minutes")
        found = np.array([opened(place, args.window) for _ in range(args.runs)])
    first, last, cpu = np.median(found, axis=0)
    print(
        f"first picture after {first:.1f} s (budget {BUDGET_S:g}), {found[:, 0].max():.1f} at most"
    )
    print(f"last after {last:.1f} s, {seconds / last:.0f} times as fast as it was recorded")
    print(f"{cpu:.1f} s of CPU")
    return 0


def make(place: Path, minutes: float) -> float:
    """→ its length [s]."""
    scenario = replace(streams.SCENARIO, contacts=round(60.0 * minutes / CONTACT_S))
    poses = streams.record(place, scenario)
    text = streams.configured(str(place))
    (place / session.CONFIG).write_text(text, encoding="utf-8")
    return poses[-1][0] - poses[0][0]


def opened(place: Path, window: bool) -> tuple[float, float, float]:
    """Seconds to the first and the last picture, and of CPU."""
    where = [] if window else ["--save", str(place.parent / "session.rrd")]
    spent, begun = cpu_s(), time.monotonic()
    command = [sys.executable, "-c", TIMED, "view", str(place), *where]
    done = subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, env=os.environ | {"TERM": "dumb"}
    )
    drawn = [float(line.split()[1]) for line in done.stdout.splitlines() if line[:5] == "drawn"]
    return drawn[0] - begun, drawn[-1] - begun, cpu_s() - spent


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(main())
