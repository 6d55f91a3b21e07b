"""Which objects touch can tell apart: trials at the end of a build of several objects.

Each object is touched in turn, and a filter that knows them all, with the table, says which one it
is. What no touch of the trials parts is alike: whoever runs these bundles together cannot expect to
be told which of them it is.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import joblib

from taxeld.estimator.bank import Known
from taxeld.layout.layout import Layout
from taxeld.proposals import bundle
from taxeld.proposals.analytic import Table
from taxeld_training.filters import identities
from taxeld_training.filters.cells import TOUCHES
from taxeld_training.filters.follow import estimator_of, follow
from taxeld_training.filters.identities import Identities
from taxeld_training.filters.methods import TABLED, TouchResult
from taxeld_training.filters.touches import FOAMS, EndTrials
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs.blocks import SEEDS_APART

STAGE = "pairs"

Run = tuple[int, int, list[TouchResult]]  # trial, number of the touched object, its touches


def pairs(
    folders: Sequence[Path],
    layout: Layout,
    asked: EndTrials,
    progress: Callable[[str, float], None],
) -> dict[str, Any]:
    """How many touches part each pair of the objects of the bundles in `folders`."""
    jobs = (
        joblib.delayed(_played)(folders, layout, asked, range(first, asked.trials, asked.workers))
        for first in range(asked.workers)
    )
    runs: list[Run] = []
    made = joblib.Parallel(asked.workers, return_as="generator")(jobs)
    for finished, part in enumerate(made, 1):
        runs += part
        progress(STAGE, finished / asked.workers)
    given = Identities.of([(true, touches) for _, true, touches in sorted(runs)])
    return {
        "foam": asked.foam,
        "trials": asked.trials,
        "seed": asked.seed,
        "touches": TOUCHES,
        "pairs": identities.parting(given, [folder.name for folder in folders]),
    }


def lines(told: dict[str, Any]) -> Iterator[str]:
    """A line for each pair that is alike, whichever of the two is touched."""
    left = {(row["object"], row["other"]): row["not_parted"] for row in told["pairs"]}
    alike = dict.fromkeys(
        tuple(sorted((row["object"], row["other"]))) for row in told["pairs"] if row["alike"]
    )
    for one, other in alike:
        share = max(left[one, other], left[other, one])
        yield (
            f"alike      {one} and {other}: {told['touches']} touches at these heights leave both "
            f"possible in {share:.0%} of {told['trials']} trials on {told['foam']} foam"
        )


def _played(folders: Sequence[Path], layout: Layout, asked: EndTrials, trials: range) -> list[Run]:
    models = [bundle.load(str(folder), layout).model for folder in folders]
    known = [Known(model, Table(model)) for model in models]
    found = []
    for seed in trials:
        own = SEEDS_APART * asked.seed + seed
        for true, model in enumerate(models):
            trial = Trial(model, own, TOUCHES, FOAMS[asked.foam])
            run = follow(trial, estimator_of(known, TABLED, own), true)
            found.append((seed, true, run))
    return found
