"""How good a bundle is, in touches: trials at the end of its build, and the filter that is enough.

A trial is a random sequence of touches of the object on the bundle's own skin. After each touch a
filter has *found* the object or not, is *sure* or not, and may *mislead*, as everywhere. Filters of
several sizes, with the bundle's own sampler and with the table, meet the same touches. The bundle
says which of them is enough, and the daemon runs that one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib

from taxeld.config import tables
from taxeld.errors import SetupError
from taxeld.estimator.bank import Known
from taxeld.layout.layout import Layout
from taxeld.proposals import bundle
from taxeld.proposals.analytic import ANALYTIC, Table
from taxeld_hil.integrity import Claims
from taxeld_training.filters import enough
from taxeld_training.filters.cells import TOUCHES
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.follow import estimator_of, follow
from taxeld_training.filters.methods import SHIPPED, Method, TouchResult, claims
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs.blocks import SEEDS_APART

STAGE = "trials"
FOAMS = {  # levels of filters/levels.py
    "exact": TrialConditions(),
    "typical": TrialConditions(skin="typical"),
    "poor": TrialConditions(skin="poor"),
}

SIZES = (25, 50, SHIPPED.particles, 200)  # N at least, of the filters that are tried


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


def size(method: Method) -> str:
    """A filter's number of particles, as bundle.json names it: 100..400."""
    return f"{method.particles}..{method.particles_max}"


def tried(sampler: str, asked: EndTrials) -> dict[str, Method]:
    """The filters that are tried, by name, cheapest first; the table's before the sampler's, which
    takes a training. Of few trials, which choose nothing, only those of the usual size."""
    sizes = SIZES if asked.trials >= enough.LEAST else (SHIPPED.particles,)
    most = SHIPPED.particles_max // SHIPPED.particles
    filters = (
        Method(name, SHIPPED.injection, n, most * n)
        for n in sizes
        for name in (Table.name, sampler)
    )
    return {f"{each.proposal} {size(each)}": each for each in filters}


def counted(
    folder: Path, layout: Layout, asked: EndTrials, progress: Callable[[str, float], None]
) -> dict[str, Any]:
    """The part of bundle.json about the trials of the bundle in `folder`: of each filter, how many
    had found their object and were sure of it after each touch, and how many misled; and the
    filter that is enough. All meet the same touches."""
    made = bundle.load(str(folder), layout)
    sampler = next(name for name in made.order if name not in ANALYTIC)
    filters = tried(sampler, asked)
    work = joblib.delayed(_played)
    jobs = (work(folder, layout, asked, filters, k) for k in range(asked.workers))
    done: dict[str, list[list[TouchResult]]] = {}
    # as in quality.reference, whose workers are then used again: starting them takes seconds
    played = joblib.Parallel(asked.workers, return_as="generator", mmap_mode="c")(jobs)
    for finished, part in enumerate(played, 1):
        for name, trials in part.items():
            done.setdefault(name, []).extend(trials)
        progress(STAGE, finished / asked.workers)
    told = {name: claims(trials) for name, trials in done.items()}
    return _chosen(filters, told, list(made.order)) | {
        "touches": {
            "foam": asked.foam,
            "trials": asked.trials,
            "seed": asked.seed,
            "found_and_sure": {k: of.found_and_sure.sum(axis=0).tolist() for k, of in told.items()},
            "misleading": {k: of.misleading.sum(axis=0).tolist() for k, of in told.items()},
        }
    }


def _chosen(
    filters: dict[str, Method], told: dict[str, Claims], order: list[str]
) -> dict[str, Any]:
    """The parts of bundle.json that the daemon runs; none where too few trials choose nothing."""
    names = list(filters)
    if len(names) < len(SIZES):
        return {}
    usual = names.index(f"{Table.name} {size(SHIPPED)}")
    own = filters[names[enough.first([enough.worth(told[name]) for name in names], usual)]]
    return {
        "auto": [own.proposal, *(name for name in order if name != own.proposal)],
        "filter": {key: getattr(own, key) for key in tables.SIZES},
    }


def _played(
    folder: Path, layout: Layout, asked: EndTrials, filters: dict[str, Method], worker: int
) -> dict[str, list[list[TouchResult]]]:
    made = bundle.load(str(folder), layout)
    found: dict[str, list[list[TouchResult]]] = {name: [] for name in filters}
    for name, method in filters.items():
        known = [Known(made.model, made.open(method.proposal))]
        for seed in range(worker, asked.trials, asked.workers):
            own = SEEDS_APART * asked.seed + seed
            trial = Trial(made.model, own, TOUCHES, FOAMS[asked.foam])
            found[name].append(follow(trial, estimator_of(known, method, own)))
    return found
