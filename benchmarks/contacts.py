"""How fast the filter closes in: error by contact on the fake clock, rules and proposals together.

python benchmarks/contacts.py --seeds 100
"""

import argparse
import os
from concurrent.futures import ProcessPoolExecutor

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one thread a worker

import numpy as np

from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario.scenario import Scenario

CONTACTS = 10
GOOD_MM = 10.0
VARIANTS = {
    "default": "",
    "mixture, N = 100": "particles_max = 100",
    "mixture, N = 100, ddpm-100": 'particles_max = 100\nproposal = "ddpm-100"',
    "mixture, N = 100, table": 'particles_max = 100\nproposal = "table"',
    "mixture, N = 100, manifold": 'particles_max = 100\nproposal = "manifold"',
    "mixture, N = 100, projection": 'particles_max = 100\nproposal = "projection"',
    "paper": 'injection = "paper"',
    "paper, ddpm-100": 'injection = "paper"\nproposal = "ddpm-100"',
    "paper, projection": 'injection = "paper"\nproposal = "projection"',
}


def errors(job: tuple[str, str, int]) -> list[float]:
    """The error [mm] after each contact; a touch too slight to begin one repeats the last."""
    bundle, keys, seed = job
    scenario = Scenario(bundle=bundle, contacts=CONTACTS)
    found = [end.error_mm for end in FakeRun(scenario, seed, filter_keys=keys).run()]
    return (found + found[-1:] * CONTACTS)[:CONTACTS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), metavar="NAME")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--bundles", nargs="+", default=["box", "mug"])
    args = parser.parse_args()
    after = (2, 3, 4, 6, 8, 10)
    print(
        f"{'median mm (share under 10 mm) after contact':44s}" + "".join(f"{k:>13d}" for k in after)
    )
    with ProcessPoolExecutor(args.workers) as pool:
        for bundle in args.bundles:
            for name in args.variants:
                jobs = [(bundle, VARIANTS[name], seed) for seed in range(args.seeds)]
                table = np.array(list(pool.map(errors, jobs)))
                cells = [
                    f"{np.median(column):6.1f} ({np.mean(column < GOOD_MM):4.0%})"
                    for column in table[:, np.array(after) - 1].T
                ]
                print(
                    f"{bundle}: {name:39s}" + "".join(f"{cell:>13s}" for cell in cells), flush=True
                )


if __name__ == "__main__":
    main()
