"""The trials of cells: jobs that run side by side and are remembered."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat, zip_longest
from typing import Any, TypeAlias

import numpy as np

from taxeld.arrays import Floats
from taxeld_sim.answers.questions import Cell, Labels
from taxeld_sim.integrity import Claims
from taxeld_sim.jobs import Job
from taxeld_sim.trials.case import Case
from taxeld_sim.trials.play import Touch, play

Run: TypeAlias = Callable[[Sequence[Job]], dict[str, Any]]  # results by job name

BLOCK = 10  # seeds a job
COLUMNS = {name: k for k, name in enumerate(Touch._fields) if name not in ("objects", "status")}


@dataclass(frozen=True)
class Played:
    """The trials of a cell."""

    labels: Labels
    known: tuple[str, ...]
    true: int  # number of the touched object; -1: the filter does not know it
    seeds: tuple[int, ...]
    trials: list[list[Touch]]

    @classmethod
    def of(cls, cell: Cell, seeds: Sequence[int], trials: Sequence[Sequence[Any]]) -> "Played":
        """Of trials as jobs have them."""
        known, touched = cell.case.known, cell.case.touched
        true = 0 if touched is None else known.index(touched) if touched in known else -1
        names = tuple(each.name for each in known)
        return cls(cell.labels, names, true, tuple(seeds), touches_of(trials))

    @property
    def claims(self) -> Claims:
        """What N trials claim after T touches each (N, T)."""
        return Claims.of_trials(self.trials)

    def records(self) -> Iterator[dict[str, Any]]:
        """A row a touch, for JSON lines."""
        for seed, trial in zip(self.seeds, self.trials, strict=True):
            for number, touch in enumerate(trial, 1):
                own = {"known": self.known, "seed": seed, "touch": number}
                yield dict(without_nan({**self.labels, **own, **touch._asdict()}))

    def column(self, name: str) -> Floats:
        """(N, T) of a field of the touches."""
        at = COLUMNS[name]
        return np.array([[touch[at] for touch in trial] for trial in self.trials], dtype=float)


def touches_of(trials: Sequence[Sequence[Any]]) -> list[list[Touch]]:
    """Trials as jobs have them."""
    return [[Touch._make(math.nan if v is None else v for v in row) for row in t] for t in trials]


def played(
    cells: Sequence[Cell],
    seeds: Sequence[int],
    run: Run,
    samplers: Sequence[Sequence[str]] = (),
) -> list[Played]:
    """The trials of cells. Each has its first block of seeds before any has its second, so that a
    part of them is as fair as all. `samplers`: of each cell the files of its known objects."""
    todo = [list[Job]() for _ in cells]
    for cell, files, mine in zip(cells, samplers or repeat(()), todo, strict=False):
        case, digest = cell.case, cell.case.digest
        of = ", ".join(filter(None, (str(cell.labels["cell"]), str(cell.labels["object"]))))
        for first in range(0, len(seeds), BLOCK):
            block = tuple(seeds[first : first + BLOCK])
            name = f"{of} by {case.method.proposal} {digest}-{block[0]}"
            mine.append(Job(name, trials, (case, block), (files,), digest))
    in_turn = [job for block in zip_longest(*todo) for job in block if job]
    done = run(list({job.name: job for job in in_turn}.values()))
    return [
        Played.of(cell, seeds, [trial for job in mine for trial in done[job.name]])
        for cell, mine in zip(cells, todo, strict=True)
    ]


def trials(case: Case, seeds: Sequence[int], samplers: Sequence[str]) -> list[list[list[Any]]]:
    """A job: of each seed the fields of each touch."""
    if samplers:
        known = zip(case.known, samplers, strict=True)
        case = replace(case, known=tuple(replace(one, sampler=file) for one, file in known))
    return [[without_nan(list(touch)) for touch in play(case, seed)] for seed in seeds]


def without_nan(value: Any) -> Any:
    """Figures as JSON holds them."""
    if isinstance(value, dict):
        return {key: without_nan(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value
