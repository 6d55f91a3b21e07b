"""Cells of the filter's experiments: trials of one method under the same conditions, as jobs.

A cell's trials are run and remembered in blocks of seeds, so that more of them go on where fewer
have stopped, and what is alike in two experiments is done once.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from taxeld.errors import SetupError
from taxeld.estimate import Status
from taxeld_training import follow, trained
from taxeld_training.conditions import Conditions
from taxeld_training.evaluate import Options, run_jobs
from taxeld_training.experiment import Setting, ring
from taxeld_training.follow import GRID, Method, Outcome
from taxeld_training.jobs import Job
from taxeld_training.trained import DENSITY
from taxeld_training.trials import Trial

COLUMNS = 16
TOUCHES = 8
BLOCK, GRID_BLOCK = 25, 5  # seeds a job: of the grid filter a trial takes seconds
SEEDS_APART = 100_000  # between the trials of one --seed and those of the next
QUICK_UPDATES = 0.02

Told = list[list[Outcome]]  # of each trial, what was said after each touch


@dataclass(frozen=True)
class Cell:
    """A method's trials with an object on a skin."""

    setting: Setting
    method: Method
    conditions: Conditions = field(default_factory=Conditions)
    felt: str = ""  # another object than the setting's, which the filter takes it for

    @property
    def name(self) -> str:
        plain = Conditions()
        given = {f.name: getattr(self.conditions, f.name) for f in fields(plain)}
        odd = [f"{key}={value:g}" for key, value in given.items() if value != getattr(plain, key)]
        parts = [self.setting.name, self.method.name, *odd, *([self.felt] if self.felt else [])]
        return "trials-" + "-".join(parts)


def setting_of(name: str, columns: int, options: Options) -> Setting:
    """An object on a skin, and how long its density is trained."""
    updates = QUICK_UPDATES if options.quick else options.effort
    return Setting(name, ring(columns), columns, updates=updates, seed=options.seed)


def chosen(methods: Sequence[Method], proposals: Sequence[str]) -> list[Method]:
    """The methods of some proposals; of all where none is named.

    Raises:
        SetupError: none has such a proposal.
    """
    known = dict.fromkeys(method.proposal for method in methods)
    for name in proposals:
        if name not in known:
            raise SetupError(f"--groups: no '{name}' here; there are {', '.join(known)}")
    return [method for method in methods if not proposals or method.proposal in proposals]


def run(wanted: Iterable[tuple[Cell, int]], options: Options) -> dict[Cell, Told]:
    """The trials of cells, as many of each as given, or as time allows.

    Densities are trained first. Then every cell has a block of its trials before any has two; the
    grid filter, which takes longest, comes last.
    """
    counts = dict(wanted)
    files = _train({cell.setting for cell in counts if cell.method.proposal == DENSITY}, options)
    todo: list[tuple[int, Cell, Job]] = []
    for cell, count in counts.items():
        density = cell.method.proposal == DENSITY
        if density and cell.setting not in files:
            continue
        file = files[cell.setting] if density else ""
        block = GRID_BLOCK if cell.method.proposal == GRID else BLOCK
        for first in range(0, count, block):
            seeds = (SEEDS_APART * options.seed + first, min(block, count - first))
            arguments = (cell, *seeds, follow.code(cell.method.proposal))
            todo.append((first, cell, Job(f"{cell.name}-{first}", play, arguments, (file,))))
    todo.sort(key=lambda each: (each[1].method.proposal == GRID, each[0]))
    done = run_jobs([job for _, _, job in todo], options)
    found: dict[Cell, Told] = {cell: [] for cell in counts}
    for _, cell, job in todo:
        found[cell] += [[_outcome(*said) for said in trial] for trial in done[job.name] or []]
    return {cell: told for cell, told in found.items() if told}


def play(cell: Cell, first: int, count: int, code: str, file: str) -> list[list[Any]]:
    """What is said in the trials of some seeds, with the density of `file`; `code` is for the
    memory alone."""
    del code
    model = trained.model_of(cell.setting)
    felt = trained.model_of(replace(cell.setting, object=cell.felt)) if cell.felt else model
    proposal = None
    if cell.method.proposal != GRID:
        proposal = trained.proposal_of(cell.method.proposal, cell.setting, file)
    return [
        [
            (_rounded(said.map_mm), _rounded(said.mean_mm), said.status, said.particles)
            for said in follow.follow(
                Trial(felt, seed, TOUCHES, cell.conditions), cell.method, model, proposal
            )
        ]
        for seed in range(first, first + count)
    ]


def _train(settings: Iterable[Setting], options: Options) -> dict[Setting, str]:
    """The file of each density, "" where it is shipped; none where time was over."""
    settings = sorted(settings, key=lambda setting: setting.name)
    todo = trained.trainings(settings, options.memory.resolve())
    done = run_jobs(list(todo.values()), options) if todo else {}
    files = {setting: "" for setting in settings if setting not in todo}
    return files | {each: job.beside[0] for each, job in todo.items() if done[job.name]}


def _rounded(error_mm: float) -> float | None:
    return round(error_mm, 4) if math.isfinite(error_mm) else None


def _outcome(
    map_mm: float | None, mean_mm: float | None, status: int | None, particles: int
) -> Outcome:
    return Outcome(
        math.nan if map_mm is None else map_mm,
        math.nan if mean_mm is None else mean_mm,
        None if status is None else Status(status),
        particles,
    )
