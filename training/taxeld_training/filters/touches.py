"""How good a bundle is, in touches: trials at the end of its build, of its own sampler and table.

A trial is a random sequence of touches of the object on the bundle's own skin. After each touch the
shipped filter has *found* the object or not, is *sure* or not, and may *mislead*, as everywhere.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib

from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.proposals import bundle
from taxeld.proposals.analytic import ANALYTIC, Table
from taxeld_training.filters.cells import SEEDS_APART, TOUCHES
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.follow import follow
from taxeld_training.filters.methods import SHIPPED
from taxeld_training.filters.trials import Trial

STAGE = "trials"
FOAMS = {  # levels of filters/levels.py
    "exact": TrialConditions(),
    "typical": TrialConditions(skin="typical"),
    "poor": TrialConditions(skin="poor"),
}

Told = list[tuple[bool, bool]]  # found and sure, misleading; of each touch of a trial


@dataclass(frozen=True)
class EndTrials:
    """The trials that a build ends with."""

    foam: str = "typical"
    trials: int = 40
    seed: int = 0
    workers: int = 2

    def __post_init__(self) -> None:
        if self.foam not in FOAMS:
            raise SetupError(f"--foam: no foam '{self.foam}'; there are {', '.join(FOAMS)}")
        if self.trials < 1:
            raise SetupError("--trials: must be 1 or more")


def counted(
    folder: Path, layout: Layout, asked: EndTrials, progress: Callable[[str, float], None]
) -> dict[str, Any]:
    """Of the trials of the bundle in `folder`, how many had found their object and were sure of it
    after each touch, and how many misled; by proposal. All meet the same touches."""
    jobs = (
        joblib.delayed(_played)(folder, layout, asked, range(first, asked.trials, asked.workers))
        for first in range(asked.workers)
    )
    done: dict[str, list[Told]] = {}
    made = joblib.Parallel(asked.workers, return_as="generator")(jobs)
    for finished, part in enumerate(made, 1):
        for name, trials in part.items():
            done.setdefault(name, []).extend(trials)
        progress(STAGE, finished / asked.workers)
    right, misleading = (
        {
            name: [sum(trial[touch][rule] for trial in trials) for touch in range(TOUCHES)]
            for name, trials in done.items()
        }
        for rule in (0, 1)
    )
    return {
        "foam": asked.foam,
        "trials": asked.trials,
        "seed": asked.seed,
        "found_and_sure": right,
        "misleading": misleading,
    }


def _played(folder: Path, layout: Layout, asked: EndTrials, seeds: range) -> dict[str, list[Told]]:
    """Trials of some seeds, by proposal: the daemon's first choice of samplers, and the table."""
    made = bundle.load(str(folder), layout)
    sampler = next(name for name in made.order if name not in ANALYTIC)
    found: dict[str, list[Told]] = {}
    for name in (sampler, Table.name):
        proposal = made.open(name)
        for seed in seeds:
            own = SEEDS_APART * asked.seed + seed
            trial = Trial(made.model, own, TOUCHES, FOAMS[asked.foam])
            touches = follow(trial, SHIPPED, made.model, proposal)
            found.setdefault(name, []).append([(t.found and t.sure, t.misleading) for t in touches])
    return found
