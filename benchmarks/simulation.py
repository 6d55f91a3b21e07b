"""Whole daemons on a fake clock with drawn faults, seed after seed (tests/rig/simulation.py).

    python benchmarks/simulation.py [--seeds 1000] [--first 0] [--workers 2] [--memory DIR]

Prints a JSON line for each seed that breaks a law, with the faults that were drawn, and at the end
how often each kind was. Seeds that are done are kept in DIR: begun again, it goes on.
"""

import argparse
import json
import logging
import os
import sys
import tempfile
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
os.environ["PYTHONPATH"] = str(ROOT)  # workers look for the tests there

from tests.rig.simulation import simulate

from taxeld_hil import jobs
from taxeld_hil.experiment import measurement


def one(seed: int) -> dict[str, Any]:
    """The figures of a seed."""
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as place:
        run, broken = simulate(seed, Path(place))
    return {
        "seed": seed,
        "broken": broken,
        "moves": run.world.moves,
        "faults": [asdict(fault) for fault in run.world.faults],
        "scans": len(run.estimates),
        "packets": len(run.taken),
        "unsent": run.unsent,
        "compared": run.compared,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--memory", type=Path, default=Path(".experiments/simulation"))
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.seeds)
    code = measurement.code()
    todo = [jobs.Job(f"seed {seed}", one, (seed,), code=code) for seed in seeds]
    found = list(jobs.run(todo, args.memory, workers=args.workers).values())
    broken = [row for row in found if row["broken"]]
    for row in broken:
        print(json.dumps(row))
    kinds = Counter(fault["kind"] for row in found for fault in row["faults"])
    sums = {name: sum(row[name] for row in found) for name in ("scans", "packets", "unsent")}
    compared = Counter(name for row in found for name in row["compared"])
    ended = {"seeds": len(found), "broken": len(broken), **sums, **compared, "faults": kinds}
    print(json.dumps(ended))
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
