"""`taxeld-train evaluate whole`: what whole filters cost, and how soon they have found an object
and are sure of it.

A filter is its rule, sampler, particles and samples. All meet the same touches. What else
runs on a machine may double the processor time of any work. So a touch is timed in relation to
scans of the same trial that tell nothing, which are the same work for every filter.
"""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.proposals.analytic import Table
from taxeld_hil.objects import meshes
from taxeld_training.filters import cells, enough, levels, stability
from taxeld_training.filters.cells import Cell, Results
from taxeld_training.filters.levels import LEVELS, Level
from taxeld_training.filters.methods import Method, TouchResult, claims
from taxeld_training.jobs.options import Options, write
from taxeld_training.objects.setting import OBJECTS
from taxeld_training.samplers.trained import DENSITY, PAPER

SEEDS, QUICK_SEEDS = 40, 1
BLOCK = 4  # trials of a job
AFTER = 6  # touches by which a filter is judged
SCENES_APART = 10**9  # seeds
ALL = "all"  # object of a row over all objects
QUIET = 0.1  # share of the quickest seconds that tell what a quiet machine takes

FILTERS = (
    *(  # N of one size
        Method(proposal, "mixture", n, n, n // 2)
        for proposal in (DENSITY, "table")
        for n in (25, 50, 100, 200, 400, 800)
    ),
    *(  # N that follows the belief, the second as it ships
        Method(proposal, "mixture", n, 4 * n, n // 2)
        for proposal in (DENSITY, "table")
        for n in (25, 50, 100, 200)
    ),
    *(Method(proposal, "mixture", 100, 400, 50) for proposal in ("manifold", "projection", PAPER)),
    *(
        Method(proposal, "mixture", 100, 400, samples)
        for proposal in (DENSITY, "table")
        for samples in (10, 25, 100, 200)
    ),
    Method(PAPER, "paper", 100),  # as published: its Fig. 3
    Method(DENSITY, "paper", 100),
    Method("table", "paper", 100),
    Method("table", "paper", 800),
    Method("table", "paper", 800, samples=0),  # a particle filter alone: no samples
)


def whole_rows(options: Options) -> list[Path]:
    """Rows {object, factor, level, proposal, injection, particles, particles_max, samples, ms,
    idle_ms, found_and_sure, …}, and the chart.

    Raises:
        SetupError: no such object, group, layout or cell.
    """
    from taxeld_training import charts  # noqa: PLC0415  # matplotlib is not needed to train

    objects = (options.objects or OBJECTS)[: 2 if options.quick else None]
    for name in objects:
        meshes.find(name)
    usual = [LEVELS[0], *(level for level in LEVELS if level.name == "skin=typical")]
    asked = levels.asked_for(options, LEVELS, usual)
    chosen = cells.chosen(FILTERS, options.groups)
    count = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    wanted = {
        (level, name): [_cell(method, level, name, options) for method in chosen]
        for level in asked
        for name in level.objects or objects
    }
    done = cells.run([(cell, count) for each in wanted.values() for cell in each], options, BLOCK)
    found: list[dict[str, Any]] = []
    for level in dict.fromkeys(level for level, _ in wanted):
        here = {
            name: {cell: done[cell] for cell in each if cell in done}
            for (own, name), each in wanted.items()
            if own is level
        }
        here = {name: each for name, each in here.items() if each}  # as far as there was time
        trials = [
            trial for each in here.values() for own in each.values() for trial in own.values()
        ]
        idle_ms = quiet_ms(touch for trial in trials for touch in trial)
        if len(here) > 1:
            here = {ALL: _pooled(list(here.values())), **here}
        found += [
            row | {"effort": options.effort}
            for name, each in here.items()
            for row in _rows(level, name, each, idle_ms)
        ]
    data = write(options, "whole", found)
    charts.front(found, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def _cell(method: Method, level: Level, name: str, options: Options) -> Cell:
    """A filter's trials in a scene: where nothing is trained, the table proposes."""
    setting = level.setting(name, options)
    return stability.cell_of(level, stability.placed(method, setting, level), setting)


def quiet_ms(touches: Iterable[TouchResult]) -> float:
    """Processor time of a second of scans that tell nothing [ms], where little else runs."""
    idle = [touch.idle_ms for touch in touches if math.isfinite(touch.idle_ms)]
    return float(np.quantile(idle, QUIET)) if idle else math.nan


def _pooled(scenes: Sequence[dict[Cell, Results]]) -> dict[Cell, Results]:
    """The trials of all scenes as of one, of the filters that ran in each, which the cells of the
    first scene stand for; of each scene the trials that all of these filters have met."""
    parts = [{cell.method: results for cell, results in each.items()} for each in scenes]
    own = [cell for cell in scenes[0] if all(cell.method in each for each in parts)]
    if not own:
        return {}
    met = [set.intersection(*(set(each[cell.method]) for cell in own)) for each in parts]
    return {
        cell: {
            SCENES_APART * k + seed: each[cell.method][seed]
            for k, (each, seeds) in enumerate(zip(parts, met, strict=True))
            for seed in sorted(seeds)
        }
        for cell in own
    }


def _rows(
    level: Level, name: str, found: dict[Cell, Results], idle_ms: float
) -> list[dict[str, Any]]:
    """The rows of a scene's filters, cheapest first. `name`: of its object; `idle_ms`: the time of
    quiet seconds on its skin."""
    rows = {
        cell: {"object": name, "factor": level.factor, "level": level.level}
        | _row(cell, results, idle_ms)
        for cell, results in found.items()
    }
    ranked = sorted(rows, key=lambda cell: rows[cell]["ms"])
    most = -math.inf
    for cell in ranked:
        share = rows[cell]["found_and_sure"][AFTER - 1] / rows[cell]["trials"]
        rows[cell]["on_front"], most = share > most, max(share, most)
    usual = [k for k, cell in enumerate(ranked) if rows[cell]["ships"]]
    seeds = set.intersection(*(set(found[cell]) for cell in ranked)) if usual else set()
    if len(seeds) >= enough.LEAST:
        told = (claims(found[cell][seed] for seed in sorted(seeds)) for cell in ranked)
        first = enough.first([enough.worth(of) for of in told], usual[0])
        rows[ranked[first]]["enough"] = True
    return [rows[cell] for cell in ranked]


def _row(cell: Cell, results: Results, idle_ms: float) -> dict[str, Any]:
    own, trials = cell.method, list(results.values())
    touches = [touch for trial in trials for touch in trial]
    row = {
        "proposal": own.proposal,
        "injection": own.injection,
        "particles": own.particles,
        "particles_max": own.particles_max or own.particles,
        "samples": own.injected,
        "ships": own.is_shipped and own.proposal == Table.name,
        "enough": False,
        "on_front": False,
    }
    spent_ms = [
        touch.cpu_ms * idle_ms / float(np.nanmedian([each.idle_ms for each in trial]))
        for trial in trials
        for touch in trial
    ]
    return row | {
        "ms": round(float(np.median(spent_ms)), 3),
        "ms_mean": round(float(np.mean(spent_ms)), 3),
        "idle_ms": round(quiet_ms(touches), 3),
        **claims(trials).by_touch(),
    }
