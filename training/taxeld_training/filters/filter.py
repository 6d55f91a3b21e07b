"""`taxeld-train evaluate filter`: a filter's error after each contact, by proposal and injection
rule (the paper's Fig. 3 and beyond), with the grid filter as the limit."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_training.filters import cells
from taxeld_training.filters.cells import COLUMNS, Cell, setting_of
from taxeld_training.filters.methods import SHIPPED, Method, TouchResult
from taxeld_training.filters.trained import DENSITY, PAPER
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.rows import GRID
from taxeld_training.objects import meshes
from taxeld_training.objects.setting import OBJECTS

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
        _row(cell, contact, results)
        for cell in wanted
        if cell in found
        for contact, results in enumerate(zip(*found[cell], strict=True), 1)
    ]


def _row(cell: Cell, contact: int, results: Sequence[TouchResult]) -> dict[str, Any]:
    method = cell.method
    return {
        "object": cell.setting.object,
        "proposal": method.proposal,
        "injection": method.injection,
        "particles": method.particles,
        "contact": contact,
        "map_mm": quantiles([result.map_mm for result in results]),
        "mean_mm": quantiles([result.mean_mm for result in results]),
        **shares(results),
        "particles_max": method.particles_max or method.particles,
        "particles_mean": round(float(np.mean([result.particles for result in results])), 1),
        "seeds": len(results),
    }


def shares(results: Sequence[TouchResult]) -> dict[str, float | None]:
    """Shares of trials that succeeded, were flagged and failed silently; the last two are None for
    a filter without a status. Where another object is touched than the filter assumes no trial
    succeeds, and one that converged failed silently."""

    def share(*rule: bool) -> float:
        return round(sum(rule) / len(rule), 4)

    has_status = results[0].status is not None
    return {
        "success_rate": share(*(result.succeeded for result in results)),
        "flagged_rate": share(*(not r.converged for r in results)) if has_status else None,
        "silent_failure_rate": share(*(r.failed_silently for r in results)) if has_status else None,
    }


def quantiles(values: Sequence[float], digits: int = 3) -> dict[str, float]:
    """As the rows of experiments have them."""
    low, median, high = np.quantile(values, [0.1, 0.5, 0.9]).tolist()
    return {"q10": round(low, digits), "median": round(median, digits), "q90": round(high, digits)}
