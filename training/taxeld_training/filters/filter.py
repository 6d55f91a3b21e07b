"""`taxeld-train evaluate filter`: a filter's error after each contact, by proposal and injection
rule (the paper's Fig. 3 and beyond), with the grid filter as the limit."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_training.filters import cells
from taxeld_training.filters.cells import COLUMNS, Cell, Results, setting_of
from taxeld_training.filters.figures import errors, p_success, shares
from taxeld_training.filters.methods import SHIPPED, Method
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.rows import GRID
from taxeld_training.objects import meshes
from taxeld_training.objects.setting import OBJECTS
from taxeld_training.samplers.trained import DENSITY, PAPER

SEEDS, QUICK_SEEDS = 200, 6
METHODS = (
    *(
        Method(proposal, injection, 100)
        for proposal in (DENSITY, "table", "manifold", "projection")
        for injection in ("mixture", "paper")
    ),
    Method(PAPER, "paper", 100),  # both of the paper: its Fig. 3
    SHIPPED,
    Method(GRID),
)


def run(options: Options) -> list[Path]:
    """Rows, table and picture."""
    from taxeld_training.charts import filter_charts  # noqa: PLC0415  # matplotlib is not needed to train

    found = rows(options)
    data = write(options, "filter", found)
    filter_charts.table(found, data.with_suffix(".md"))
    filter_charts.draw(found, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def rows(options: Options) -> list[dict[str, Any]]:
    """A row an object, method and contact."""
    methods = cells.chosen(METHODS, options.groups)
    objects = options.objects or OBJECTS
    for name in objects:
        meshes.find(name)
    objects = objects[:2] if options.quick else objects
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    wanted = [
        Cell(setting_of(name, COLUMNS, options), method) for name in objects for method in methods
    ]
    found = cells.run([(cell, seeds) for cell in wanted], options)
    return [
        _row(cell, contact, found[cell], found.get(_shipped(cell)))
        for cell in wanted
        if cell in found
        for contact in range(1, cells.TOUCHES + 1)
    ]


def _shipped(cell: Cell) -> Cell:
    """The same trials by the configuration that ships."""
    return replace(cell, method=SHIPPED)


def _row(cell: Cell, contact: int, results: Results, shipped: Results | None) -> dict[str, Any]:
    method = cell.method
    last = [trial[contact - 1] for trial in results.values()]
    return {
        "object": cell.setting.object,
        "proposal": method.proposal,
        "injection": method.injection,
        "particles": method.particles,
        "contact": contact,
        **errors(last, "map_mm"),
        **errors(last, "mean_mm"),
        **shares(results, contact),
        "p_shipped": None if shipped is None else p_success(results, shipped, contact),
        "particles_max": method.particles_max or method.particles,
        "particles_mean": round(float(np.mean([result.particles for result in last])), 1),
        "seeds": len(results),
    }
