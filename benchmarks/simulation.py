"""Whole daemons on a fake clock with drawn faults, seed after seed (tests/daemon/simulation.py).

    python benchmarks/simulation.py [--seeds 1000] [--first 0] [--workers 2] [--json FILE]

Prints a JSON line for each seed that breaks a law, with the faults that were drawn, and at the end
how often each kind was. FILE gets a line for each seed as it is done: begun again with the same
file, it goes on. Ctrl-C ends it with what is done.
"""

import argparse
import json
import logging
import multiprocessing
import os
import sys
import tempfile
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(name, "1")

from tests.daemon.simulation import simulate


def one(seed: int) -> dict[str, Any]:
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as place:
        run, broken = simulate(seed, Path(place))
    return {
        "seed": seed, "broken": broken, "moves": run.world.moves,
        "faults": [asdict(fault) for fault in run.world.faults], "scans": len(run.estimates),
        "packets": len(run.taken), "unsent": run.unsent, "compared": run.compared,
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = _before(args.json)
    done = {row["seed"] for row in found}
    seeds = [s for s in range(args.first, args.first + args.seeds) if s not in done]
    with multiprocessing.Pool(args.workers, maxtasksperchild=50) as pool:
        try:
            for row in pool.imap_unordered(one, seeds):
                found.append(row)
                if row["broken"]:
                    print(json.dumps(row), flush=True)
                if args.json:
                    with args.json.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(row) + "\n")
                if len(found) % 10 == 0:
                    print(f"{len(found)} done", file=sys.stderr, end="\r", flush=True)
        except KeyboardInterrupt:
            pool.terminate()
    kinds = Counter(fault["kind"] for row in found for fault in row["faults"])
    broken = sum(bool(row["broken"]) for row in found)
    sums = {name: sum(row[name] for row in found) for name in ("scans", "packets", "unsent")}
    compared = Counter(name for row in found for name in row["compared"])
    print(json.dumps({"seeds": len(found), "broken": broken, **sums, **compared, "faults": kinds}))
    return int(broken > 0)


def _before(path: Path | None) -> list[dict[str, Any]]:
    """What an earlier run has done."""
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


if __name__ == "__main__":
    sys.exit(main())
