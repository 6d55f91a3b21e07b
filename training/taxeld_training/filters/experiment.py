"""`taxeld-train evaluate filter` and `stability`: filters in trials, by method and condition.

`filter` has a row for each contact: of all methods, where all is as they assume (the paper's Fig. 3
and beyond), or under the conditions that `--cells` names. `stability` has the last contact alone,
of few methods over the whole table of conditions: where filters fail, and whether they report it.
The grid filter is the limit: what it does not find, no filter of its likelihood finds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from taxeld_training.filters import cells, levels
from taxeld_training.filters.cells import TOUCHES, Cell, Results
from taxeld_training.filters.figures import against, errors, shares
from taxeld_training.filters.levels import BESIDE_THE_MAP, LEVELS, Level
from taxeld_training.filters.methods import SHIPPED, Method
from taxeld_training.jobs import tables
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.rows import GRID, SUCCESS_MM, Row
from taxeld_training.objects import meshes
from taxeld_training.objects.setting import OBJECTS, Setting
from taxeld_training.samplers import trained
from taxeld_training.samplers.trained import DENSITY, PAPER

Draw: TypeAlias = Callable[[Sequence[Row], Path], None]
FOUND_SHARE = 0.1  # error under which an object is found, as a share of its mean diameter


@dataclass(frozen=True)
class Experiment:
    """Which trials are run, if nothing else is asked for."""

    methods: tuple[Method, ...]
    objects: tuple[str, ...]
    contacts: tuple[int, ...]  # contacts with a row of their own, counted from 1
    seeds: int  # trials of a cell
    quick_seeds: int  # trials of a cell with --quick


FILTER = Experiment(
    (
        *(
            Method(proposal, injection, 100)
            for proposal in (DENSITY, "table", "manifold", "projection")
            for injection in ("mixture", "paper")
        ),
        Method(PAPER, "paper", 100),  # both of the paper: its Fig. 3
        SHIPPED,
        Method(GRID, touches=(4, 6, 8)),  # minutes a trial if it looked after each
    ),
    OBJECTS, tuple(range(1, TOUCHES + 1)), seeds=200, quick_seeds=6,
)  # fmt: skip
STABILITY = Experiment(
    (
        SHIPPED,
        replace(SHIPPED, proposal="table"),
        Method(DENSITY, "paper", 100),
        Method("projection", "paper", 100),
    ),
    ("003_cracker_box", "025_mug"), (TOUCHES,), seeds=100, quick_seeds=3,
)  # fmt: skip


def filter_rows(options: Options) -> list[Path]:
    """Rows, table and picture of `evaluate filter`.

    Raises:
        SetupError: no such object, group or cell.
    """
    from taxeld_training.charts import trial_charts  # noqa: PLC0415  # matplotlib is not needed to train

    objects = (options.objects or FILTER.objects)[: 2 if options.quick else None]
    found = rows(FILTER, levels.chosen(options.cells or ("as assumed",)), objects, options)
    return _written(options, "filter", found, trial_charts.by_contact)


def stability_rows(options: Options) -> list[Path]:
    """Rows, table and map of `evaluate stability`.

    Raises:
        SetupError: no such object, group or cell.
    """
    from taxeld_training.charts import trial_charts  # noqa: PLC0415

    table = [level for level in LEVELS if not level.objects or not options.objects]
    if options.cells:
        table = levels.chosen(options.cells, table)
    else:
        table = [level for level in table if level.factor not in BESIDE_THE_MAP]
        if options.quick:  # the last level of each factor
            table = list({level.factor: level for level in table}.values())
    found = rows(STABILITY, table, options.objects or STABILITY.objects, options)
    return _written(options, "stability", found, trial_charts.failures)


def _written(options: Options, name: str, found: list[dict[str, Any]], draw: Draw) -> list[Path]:
    """The files of an experiment. Chosen cells do not take the place of the whole table's rows."""
    data = write(options, f"{name}_cells" if options.cells else name, found)
    tables.save(tables.trials(found), data)
    draw(found, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def rows(
    experiment: Experiment, table: Sequence[Level], objects: Sequence[str], options: Options
) -> list[dict[str, Any]]:
    """A row an object, level, method and contact."""
    for name in objects:
        meshes.find(name)
    methods = cells.chosen(experiment.methods, options.groups)
    seeds = options.seeds or (experiment.quick_seeds if options.quick else experiment.seeds)
    wanted = dict.fromkeys(  # methods may differ in nothing but particles, which a level may set
        (level, cell_of(level, method, setting))
        for level in table
        for name in level.objects or objects
        for setting in [level.setting(name, options)]
        for method in methods
        if not (level.lengths and trained.is_learned(method.proposal, setting))
    )
    found = cells.run([(cell, round(level.seeds * seeds)) for level, cell in wanted], options)
    return [
        _row(level, cell, contact, found[cell], found.get(cell_of(level, SHIPPED, cell.setting)))
        for level, cell in wanted
        if cell in found
        for contact in experiment.contacts
        if contact in (cell.method.touches or experiment.contacts)
    ]


def cell_of(level: Level, method: Method, setting: Setting) -> Cell:
    """A method's trials under the conditions of a level."""
    if level.particles and method.particles:
        method = replace(method, particles=level.particles, particles_max=0)
    return Cell(setting, method, level.conditions, level.touched)


def _row(
    level: Level, cell: Cell, contact: int, results: Results, shipped: Results | None
) -> dict[str, Any]:
    """The row of a cell and contact; `shipped` has the trials of what ships under the same
    conditions. Errors of other lengths are in hundredths of the object's mean diameter."""
    method = cell.method
    of_lengths: dict[str, float] = {}
    if level.lengths:
        diameter_mm = 2e3 * trained.model_of(cell.setting).scene.mean_radius
        of_lengths = {"diameter_mm": round(diameter_mm, 1)}
        unit = SUCCESS_MM / (FOUND_SHARE * diameter_mm)
        results = {s: [each.scaled(unit) for each in trial] for s, trial in results.items()}
    last = [trial[contact - 1] for trial in results.values()]
    return {
        "object": cell.setting.object,
        "factor": level.factor,
        "level": level.level,
        "proposal": method.proposal,
        "injection": method.injection,
        "particles": method.particles,
        "contact": contact,
        **of_lengths,
        **errors(last, "map_mm"),
        **errors(last, "mean_mm"),
        **shares(results, contact),
        **against(results, shipped, contact),
        "particles_max": method.particles_max or method.particles,
        "particles_mean": round(float(np.mean([result.particles for result in last])), 1),
        "seeds": len(results),
    }
