"""Cells of the filter's experiments: trials of one method under the same conditions, as jobs.

Two experiments share the cells that they have in common.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from taxeld.estimator.estimate import Hypotheses, Status
from taxeld_training.filters import follow
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.guides import Guide
from taxeld_training.filters.identities import UNKNOWN
from taxeld_training.filters.methods import GRID, SHIPPED, Method, TouchResult
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs import blocks
from taxeld_training.jobs.options import Options, check
from taxeld_training.objects.setting import Setting, ring
from taxeld_training.samplers import trained

COLUMNS = 16
TOUCHES = 8
BLOCK, GRID_BLOCK = 25, 5  # seeds a job; a trial of the grid filter takes seconds
QUICK_UPDATES = 0.02

Results = dict[int, list[TouchResult]]  # results of each touch, by the trial's seed


@dataclass(frozen=True)
class Cell:
    """A method's trials with an object on a skin."""

    setting: Setting
    method: Method
    conditions: TrialConditions = field(default_factory=TrialConditions)
    touched: str = ""  # object of the trials; empty: the setting's object, which the filter assumes
    more: tuple[Setting, ...] = ()  # further objects that the filter knows, on the same skin
    guide: str = ""  # of `GUIDES`; empty: presses know where the object is

    @property
    def known(self) -> tuple[Setting, ...]:
        """The objects that the filter knows."""
        return (self.setting, *self.more)

    @property
    def touches(self) -> Setting:
        """The touched object."""
        return replace(self.setting, object=self.touched or self.setting.object)

    @property
    def name(self) -> str:
        """Another one for each cell of a run."""
        digest = hashlib.sha256(repr(self).encode()).hexdigest()[:8]
        return f"{self.setting.name} {self.method.proposal} {self.method.injection} {digest}"


def setting_of(name: str, columns: int, options: Options) -> Setting:
    """An object on a ring of `columns`; a quick run trains its density for less long."""
    updates = QUICK_UPDATES if options.quick else options.effort
    return Setting(name, ring(columns), columns, updates=updates, seed=options.seed)


def chosen(methods: Sequence[Method], names: Sequence[str]) -> list[Method]:
    """The methods with a proposal of `names`, or the one that ships if it is named `shipped`; all
    methods if none is named.

    Raises:
        SetupError: no method has such a proposal.
    """
    known = [*dict.fromkeys(method.proposal for method in methods), "shipped"]
    check("--groups", names, known)
    return [
        method
        for method in methods
        if not names or method.proposal in names or (method == SHIPPED and "shipped" in names)
    ]


def run(wanted: Iterable[tuple[Cell, int]], options: Options, size: int = 0) -> dict[Cell, Results]:
    """Results of cells, of as many trials of each as given, or as time allows, by blocks
    of `size` or the usual one. Models are trained first; the grid filter, which takes longest,
    comes last."""
    counts = dict(wanted)
    files = trained.files(((cell.setting, cell.method.proposal) for cell in counts), options)
    ready = {
        cell: file
        for cell in counts
        if (file := files.get((cell.setting, cell.method.proposal))) is not None
    }

    def is_grid(cell: Cell) -> bool:
        return cell.method.proposal == GRID

    done = blocks.trials(
        {cell: counts[cell] for cell in ready},
        play,
        options,
        lambda cell: GRID_BLOCK if is_grid(cell) else size or BLOCK,
        files=ready,
        is_late=is_grid,
    )
    return {
        cell: {seed: [read(*touch) for touch in trial] for seed, trial in trials.items()}
        for cell, trials in done.items()
    }


def play(cell: Cell, first: int, count: int, file: str) -> list[list[Any]]:
    """Results of the trials of `count` seeds, a list of a `TouchResult`'s fields for each touch;
    `file` has a learned proposal."""
    touched = trained.model_of(cell.touches)
    true = cell.known.index(cell.touches) if cell.touches in cell.known else UNKNOWN
    found = []
    for seed in range(first, first + count):
        trial = Trial(touched, seed, TOUCHES, cell.conditions)
        if cell.method.proposal == GRID:
            model = trained.model_of(cell.setting)
            found.append(follow.follow_grid(trial, model, cell.method.touches, true))
            continue
        known = [trained.known_of(each, cell.method.proposal, file) for each in cell.known]
        estimator = follow.estimator_of(known, cell.method, seed)
        guide = Guide(cell.guide, estimator, seed) if cell.guide else None
        run = follow.follow(replace(trial, guide=guide), estimator, true)
        costs_ms = [0.0, *guide.costs_ms] if guide and guide.costs_ms else [0.0] * len(run)
        found.append([each._replace(guide_ms=ms) for each, ms in zip(run, costs_ms, strict=True)])
    return [[_rounded(touch) for touch in trial] for trial in found]


def _rounded(touch: TouchResult) -> TouchResult:
    objects = [float(f"{share:.6g}") for share in touch.objects]
    return touch._replace(map_mm=round(touch.map_mm, 4), objects=objects)


def read(
    map_mm: float,
    status: int | None,
    particles: int,
    p: float,
    radius_m: float,
    hypotheses: Sequence[float],
    *rest: Any,
) -> TouchResult:
    """A touch as a job's file has it."""
    known = None if status is None else Status(status)
    return TouchResult(map_mm, known, particles, p, radius_m, Hypotheses(*hypotheses), *rest)
