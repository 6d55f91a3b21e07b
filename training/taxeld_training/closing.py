"""The trials that a build ends with: whether a sampler pays, and what touch cannot tell apart.

They are trials as everywhere: after each touch a filter has *found* the object or not, is *sure* or
not, and may *mislead*. Filters of several sizes with the table, and one with the bundle's own
sampler, meet the same touches. The bundle says which of them is enough, and the daemon runs that.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Floats
from taxeld.config import tables
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld_sim import jobs
from taxeld_sim.answers.played import Played, played
from taxeld_sim.answers.questions import Cell
from taxeld_sim.answers.score import by_seeds
from taxeld_sim.integrity import Claims
from taxeld_sim.trials.case import TABLED, Case, Method
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.subjects import Subject
from taxeld_training.progress import Tell

STAGE, PAIRS = "trials", "pairs"
FOAMS = {"exact": Conditions()} | {foam: Conditions(foam=foam) for foam in ("typical", "poor")}
SIZES = (25, 50, TABLED.particles, 200)  # N at least, of the filters that are tried
TOUCHES = 8  # of a trial
ENOUGH, FEW = 40, 8  # trials; fewer than enough choose no filter
MARGIN = 0.01  # share of the touches by which a filter that is as good may fall behind
MISLED = 10.0  # touches found and sure that one misleading takes away
PARTED = 0.99  # probability of the touched object, were there but one other, that parts the two
ALIKE = 0.5  # share of trials that leave two objects together, from which they are alike
WORKERS = 2


def size(method: Method) -> str:
    """A filter's number of particles, as bundle.json names it: 100..400."""
    return f"{method.particles}..{method.particles_max}"


def tried(sampler: str, trials: int) -> dict[str, Method]:
    """The filters that are tried, by name: the table's, cheapest first, and the sampler's. Of few
    trials, which choose nothing, only those of the usual size."""
    sizes = SIZES if trials >= ENOUGH else (TABLED.particles,)
    most = TABLED.particles_max // TABLED.particles
    filters = [replace(TABLED, particles=n, particles_max=most * n) for n in sizes]
    filters.append(replace(TABLED, proposal=sampler))
    return {f"{each.proposal} {size(each)}": each for each in filters}


def counted(folder: Path, layout: str, foam: str, trials: int, tell: Tell) -> dict[str, Any]:
    """The part of bundle.json about the trials of the bundle in `folder`: of each filter, how many
    had found their object and were sure of it after each touch, and how many misled; and the
    filter that is enough. All meet the same touches."""
    manifest = bundle.load(str(folder), layouts.load(layout)).manifest
    filters = tried(manifest.samplers[0].name, trials)
    case = case_of([folder], layout, foam)
    cells = [cell(name, replace(case, method=each)) for name, each in filters.items()]
    done = run(cells, trials, partial(tell, STAGE))
    told = {str(each.labels["cell"]): each.claims for each in done}
    return chosen(filters, told, manifest.auto) | {
        "touches": {
            "foam": foam,
            "trials": trials,
            "found_and_sure": {k: of.found_and_sure.sum(axis=0).tolist() for k, of in told.items()},
            "misleading": {k: of.misleading.sum(axis=0).tolist() for k, of in told.items()},
        }
    }


def pairs(
    folders: Sequence[Path], layout: str, foam: str, trials: int, tell: Tell
) -> dict[str, Any]:
    """How many touches part each pair of the objects of the bundles in `folders`. Each object is
    touched in turn, and a filter that knows them all, with the table, says which one it is. What
    the trials do not part is alike: whoever runs these bundles together cannot expect to be told
    which of them it is."""
    case, names = case_of(folders, layout, foam), [folder.name for folder in folders]
    cells = [cell(one.name, replace(case, touched=one)) for one in case.known]
    found = []
    for each in run(cells, trials, partial(tell, PAIRS)):
        objects = np.array([[touch.objects for touch in trial] for trial in each.trials])
        found += [
            {"object": names[each.true], "other": name, **parting(objects, each.true, k)}
            for k, name in enumerate(names)
            if k != each.true
        ]
    return {"foam": foam, "trials": trials, "touches": TOUCHES, "pairs": found}


def case_of(folders: Sequence[Path], layout: str, foam: str) -> Case:
    """Trials of a filter that knows the objects of all bundles."""
    known = tuple(Subject(str(folder)) for folder in folders)
    return Case(known, None, (layout,), FOAMS[foam], touches=TOUCHES)


def cell(name: str, case: Case) -> Cell:
    return Cell({"cell": name, "object": case.subject.name}, case)


def run(cells: Sequence[Cell], trials: int, progress: Callable[[float], None]) -> list[Played]:
    """So many trials of each cell, kept nowhere."""
    with tempfile.TemporaryDirectory() as memory:
        on = partial(jobs.run, memory=Path(memory), workers=WORKERS, tell=progress)
        return played(cells, range(trials), on)


def parting(objects: Floats, true: int, other: int) -> dict[str, Any]:
    """How many touches part two objects, by the probabilities (N, T, K) of all in N trials with the
    object `true`. A trial parts them once that one has a probability of `PARTED`, were there but
    these two, to the end; null: not by then."""
    touches = objects.shape[1]
    apart = objects[..., true] >= PARTED * (objects[..., true] + objects[..., other])
    stays = np.logical_and.accumulate(apart[:, ::-1], axis=1)
    after = touches - stays.sum(axis=1) + 1  # touches + 1: never
    median, most = np.quantile(after, [0.5, 0.9], method="inverted_cdf").tolist()
    left = float((after > touches).mean())
    return {
        "median": int(median) if median <= touches else None,
        "q90": int(most) if most <= touches else None,
        "not_parted": round(left, 4),
        "alike": left >= ALIKE,
        "trials": len(objects),
    }


def enough(worths: Sequence[Floats], usual: int) -> int:
    """Index of the first filter that is shown to fall behind the best by at most `MARGIN`, of
    filters with worths (T,) in the same trials, T > 1.

    The best is the `usual` one, unless another is shown to be better. It is shown where the
    interval of the paired difference, over trials drawn anew, says so: of what too few trials tell
    apart the usual one is kept.
    """
    best = max(range(len(worths)), key=lambda k: float(worths[k].mean()))
    if _mean(worths[best] - worths[usual])[0] <= 0.0:
        best = usual
    behind = (_mean(worths[best] - each)[1] for each in worths)
    return next(k for k, most in enumerate(behind) if k == best or most <= MARGIN)


def _mean(values: Floats) -> list[float]:
    """Interval of the mean of values (T,) of trials."""
    return by_seeds(np.mean, values, np.arange(len(values)))


def worth(of: Claims) -> Floats:
    """(N,) of each trial: the share of its touches after which the object was found and the filter
    sure. A touch after which it was sure and wrong takes `MISLED` of them away."""
    return np.asarray((of.found_and_sure - MISLED * of.misleading).mean(axis=1))


def chosen(
    filters: dict[str, Method], told: dict[str, Claims], order: Sequence[str]
) -> dict[str, Any]:
    """The parts of bundle.json that the daemon runs; none where too few trials choose nothing. A
    sampler, which takes a training, is chosen where it is shown to be better than the table."""
    *tables_own, sampler = filters
    if len(tables_own) < len(SIZES):
        return {}
    worths, usual = [worth(told[name]) for name in filters], SIZES.index(TABLED.particles)
    is_better = _mean(worths[-1] - worths[usual])[0] > 0.0
    own = filters[sampler if is_better else tables_own[enough(worths[:-1], usual)]]
    return {
        "auto": [own.proposal, *(name for name in order if name != own.proposal)],
        "filter": {key: getattr(own, key) for key in tables.SIZES},
    }
