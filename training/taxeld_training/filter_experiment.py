"""`taxeld-train evaluate filter`: errors against contacts, proposals × injection rules (the paper's
Fig. 3 and beyond), with the grid filter as the limit."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.config import FilterConfig
from taxeld_training import cells, meshes
from taxeld_training.cells import COLUMNS, Cell, setting_of
from taxeld_training.evaluate import Options, write
from taxeld_training.follow import GRID, Method, Outcome
from taxeld_training.trained import DENSITY

SEEDS, QUICK_SEEDS = 200, 6
METHODS = (
    *(
        Method(proposal, injection, 100)
        for proposal in (DENSITY, "table", "manifold", "projection")
        for injection in ("mixture", "paper")
    ),
    Method(DENSITY, "mixture", FilterConfig().particles, FilterConfig().particles_max),
    Method(GRID),
)


def run(options: Options) -> list[Path]:
    """Rows, table and picture."""
    from taxeld_training import filter_charts  # noqa: PLC0415  # matplotlib is not needed to train

    found = rows(options)
    data = write(options, "filter", found)
    filter_charts.table(found, data.with_suffix(".md"))
    filter_charts.draw(found, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def rows(options: Options) -> list[dict[str, Any]]:
    """A row an object, method and contact."""
    methods = cells.chosen(METHODS, options.groups)
    for name in options.objects:
        meshes.find(name)
    objects = options.objects[:2] if options.quick else options.objects
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    wanted = [
        Cell(setting_of(name, COLUMNS, options), method) for name in objects for method in methods
    ]
    told = cells.run([(cell, seeds) for cell in wanted], options)
    return [
        _row(cell, contact, outcomes)
        for cell in wanted
        if cell in told
        for contact, outcomes in enumerate(zip(*told[cell], strict=True), 1)
    ]


def _row(cell: Cell, contact: int, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    method = cell.method
    return {
        "object": cell.setting.object,
        "proposal": method.proposal,
        "injection": method.injection,
        "particles": method.particles,
        "contact": contact,
        "map_mm": _quantiles([outcome.map_mm for outcome in outcomes]),
        "mean_mm": _quantiles([outcome.mean_mm for outcome in outcomes]),
        **shares(outcomes),
        "particles_max": method.particles_max or method.particles,
        "particles_mean": round(float(np.mean([outcome.particles for outcome in outcomes])), 1),
        "seeds": len(outcomes),
    }


def shares(outcomes: Sequence[Outcome]) -> dict[str, float | None]:
    """Of trials. Those of another object are no successes, and to have converged is to have failed;
    what a filter does not say of itself is None."""

    def share(*rule: bool) -> float:
        return round(sum(rule) / len(rule), 4)

    told = outcomes[0].status is not None
    return {
        "success_rate": share(*(outcome.succeeded for outcome in outcomes)),
        "flagged_rate": share(*(not o.converged for o in outcomes)) if told else None,
        "silent_failure_rate": share(*(o.failed_silently for o in outcomes)) if told else None,
    }


def _quantiles(errors: Sequence[float]) -> dict[str, float]:
    low, median, high = np.quantile(errors, [0.1, 0.5, 0.9]).tolist()
    return {"q10": round(low, 3), "median": round(median, 3), "q90": round(high, 3)}
