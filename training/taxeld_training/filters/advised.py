"""`taxeld-train evaluate advice`: how many touches it takes, by who says where they are made.

All guides have the same object at the same place and the same first touch; an approach that meets
nothing counts as a touch. Which object it is, too: a box, and the same box a little shorter, which
the filter both knows. The table proposes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld.errors import SetupError
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import SURE
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import add_m
from taxeld.proposals.analytic import Table
from taxeld_hil.integrity import FOUND_MM
from taxeld_hil.jobs import Job
from taxeld_hil.objects import HEIGHT_M, meshes, scenes
from taxeld_training.filters.cells import COLUMNS, TOUCHES, seed_of, setting_of
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.follow import OWN_SEEDS
from taxeld_training.filters.guides import ADVICE, ALL_LINES, ANY, GUIDES, OPPOSITE, RANDOM, Guide
from taxeld_training.filters.several import TABLED, known_of
from taxeld_training.filters.touches import FOAMS
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs.options import Options, run_jobs, write
from taxeld_training.objects import DEPTH_MAX_M
from taxeld_training.objects.setting import OBJECTS, Setting, ring

SEEDS, QUICK_SEEDS = 40, 1
BLOCK = 5  # seeds a job
MANY = "025_mug", "035_power_drill"  # objects whose touches tell little: SEEDS of each
FEWER, FEWEST = 0.5, 0.25  # factors of the number of trials with others, and by all lines
CELLS = {
    "exact": FOAMS["exact"],
    "typical": FOAMS["typical"],
    "robot 1 mm": TrialConditions(sensor_sd_m=0.001),
}
GUIDED = {"exact": (ANY, RANDOM, OPPOSITE, ADVICE)}  # guides by cell, of MANY
USUAL = (ANY, RANDOM, ADVICE)
ALIKE = "003_cracker_box"  # the box that there is a shorter one of
SHORTER_M = 0.015
DUE = 0.9  # share of trials that are to be right and sure


class AdvisedTouch(NamedTuple):
    """The estimate after a touch."""

    error_mm: float  # symmetric ADD; as if the object that is named were the one that is touched
    p: float
    right: bool  # whether the likeliest object is the one that is touched
    contacts: int  # touches so far that met anything
    advice_ms: float  # processor time of the advice before this touch; 0 without


@dataclass(frozen=True)
class GuidedTrials:
    """Trials of an object under a guide."""

    setting: Setting
    cell: str  # of `CELLS`
    guide: str  # of `GUIDES`
    alike: bool = False  # whether the filter knows the shorter box as well, touched in turn


def advice_rows(options: Options) -> list[Path]:
    """Rows and picture of `evaluate advice`.

    Raises:
        SetupError: no such object, guide or cell.
    """
    from taxeld_training.charts import advice_chart  # noqa: PLC0415  # matplotlib is not needed to train

    for option, names, known in (
        ("groups", options.groups, GUIDES),
        ("cells", options.cells, CELLS),
    ):
        for name in set(names).difference(known):
            raise SetupError(f"--{option}: no '{name}'; there are {', '.join(known)}")
    todo = [
        (given, Job(f"advice {given} {first}", play, (given, seed_of(options, first), size)))
        for given, count in wanted(options)
        for first in range(0, count, BLOCK)
        for size in [min(BLOCK, count - first)]
    ]
    todo.sort(key=lambda each: each[1].arguments[1])  # a first block of all before any second
    done = run_jobs([job for _, job in todo], options)
    found: dict[GuidedTrials, list[Any]] = {}
    for given, job in todo:
        found.setdefault(given, []).extend(done[job.name] or [])
    rows = [_row(given, trials) for given, trials in found.items() if trials]
    data = write(options, "advice", rows)
    advice_chart.draw(rows, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def wanted(options: Options) -> list[tuple[GuidedTrials, int]]:
    """Which trials, and how many of each: mug and drill under all conditions, then the box, and
    which of two boxes it is; then the others on exact readings."""
    count = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    fewer = max(round(FEWER * count), 1)
    names = options.objects or (*MANY, *(name for name in OBJECTS if name not in MANY))
    found = []
    for name in names:
        setting, many = setting_of(name, COLUMNS, options), name in MANY
        for cell in CELLS if many or name == ALIKE else ("exact",):
            guides = GUIDED.get(cell, USUAL) if many else (RANDOM, ADVICE)
            trials = count if many else fewer
            found += [(GuidedTrials(setting, cell, guide), trials) for guide in guides]
        if name == MANY[0]:
            found.append((GuidedTrials(setting, "exact", ALL_LINES), max(round(FEWEST * count), 1)))
        if name == ALIKE:
            found += [
                (GuidedTrials(setting, "exact", each, True), fewer) for each in (RANDOM, ADVICE)
            ]
    chosen, cells = options.groups or GUIDES, options.cells or CELLS
    return [each for each in found if each[0].guide in chosen and each[0].cell in cells]


def play(given: GuidedTrials, first: int, count: int) -> list[list[AdvisedTouch]]:
    """Results of the trials of `count` seeds, of each touch."""
    known = [known_of(given.setting)]
    if given.alike:
        known.append(shorter(given.setting.object))
    return [_played(given, known, seed % len(known), seed) for seed in range(first, first + count)]


@lru_cache(maxsize=1)
def shorter(name: str) -> Known:
    """An object that is SHORTER_M shorter along the longer of its sides."""
    mesh, skin = meshes.load(meshes.find(name)[0]).copy(), layouts.load(ring(COLUMNS))
    scale, side = np.ones(3), int(np.argmax(mesh.extents[:2]))
    scale[side] -= SHORTER_M / mesh.extents[side]
    mesh.apply_scale(scale)
    model = ObservationModel(scenes.build(mesh, skin, HEIGHT_M), skin, DEPTH_MAX_M)
    return Known(model, Table(model))


def _played(
    given: GuidedTrials, known: Sequence[Known], true: int, seed: int
) -> list[AdvisedTouch]:
    first, *more = known
    config = TABLED.config(OWN_SEEDS + seed)
    estimator = Estimator(first.model, first.proposal, config, more=more)
    guide, found = Guide(given.guide, estimator, seed), []
    trial = Trial(known[true].model, seed, TOUCHES, CELLS[given.cell], guide)
    for _, moments in groupby(trial, lambda moment: moment.touch):
        for moment in moments:
            estimator.on_scan(moment.activation, moment.sensor)
        now = estimator.estimate
        error_mm = 1e3 * add_m(known[now.object].model.scene, now.map, moment.truth)[1]
        cost_ms = guide.costs_ms[-1] if guide.costs_ms else 0.0
        found.append(
            AdvisedTouch(round(error_mm, 3), now.p, now.object == true, now.contacts, cost_ms)
        )
    return found


def _row(given: GuidedTrials, trials: Sequence[Any]) -> dict[str, Any]:
    """Shares after each touch, and what an advice costs."""
    error_mm, p, right, contacts, spent_ms = np.moveaxis(np.array(trials), -1, 0)
    found, sure = (error_mm < FOUND_MM) & (right > 0.0), p >= SURE
    due = np.flatnonzero((found & sure).mean(axis=0) >= DUE)
    row: dict[str, Any] = {
        "object": given.setting.object,
        "cell": given.cell,
        "guide": given.guide,
        "alike": given.alike,
        "trials": len(error_mm),
        "found": found.mean(axis=0).round(3).tolist(),
        "found_and_sure": (found & sure).mean(axis=0).round(3).tolist(),
        "touches_to_90": int(due[0]) + 1 if len(due) else None,
        "misleading": int((sure & ~found).sum()),
        "median_mm": round(float(np.median(error_mm[:, -1])), 3),
        "missed": round(float(1.0 - contacts[:, -1].mean() / contacts.shape[1]), 3),
    }
    if given.alike:
        row["right_object"] = right.mean(axis=0).round(3).tolist()
    if spent_ms.any():
        spent_ms = spent_ms[spent_ms > 0.0]
        row["advice_ms"] = round(float(np.median(spent_ms)), 2)
        row["advice_ms_95"] = round(float(np.percentile(spent_ms, 95.0)), 2)
    return row
