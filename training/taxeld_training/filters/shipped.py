"""`taxeld-train evaluate shipped`: the configuration that ships, contact by contact, where all is
exact, where the robot errs, where the object gives way, and on soft skins. With the group `grid`
the grid filter stands beside it, on the same trials: what it does not find either, no filter of
this likelihood does."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_training.filters import cells
from taxeld_training.filters.cells import COLUMNS, Cell, Results, setting_of
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.figures import errors, p_success, shares
from taxeld_training.filters.methods import SHIPPED, Method
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.rows import GRID
from taxeld_training.objects import meshes

OBJECTS = ("003_cracker_box", "025_mug")
SEEDS, QUICK_SEEDS = 100, 10
CONDITIONS = {
    "exact": Conditions(),
    "robot 2 mm": Conditions(sensor_sd_m=0.002),
    "nudged 1 mm": Conditions(nudged_m=0.001),
    "nudged 2 mm": Conditions(nudged_m=0.002),
    "moved 2 mm": Conditions(pushed_m=0.002, pushed_rad=float(np.deg2rad(0.6))),
    **{f"{skin} skin": Conditions(skin=skin) for skin in ("typical", "poor")},
}


METHODS = {
    "default": SHIPPED,
    GRID: Method(GRID, touches=(4, 6, 8)),  # minutes a trial, if after each
}


def run(options: Options) -> list[Path]:
    """Rows {object, condition, method, contact, map_mm, seeds and what `figures.shares` has; of the
    grid what `_beside` has}, and a table of them.

    Raises:
        SetupError: no such condition.
    """
    objects = options.objects or OBJECTS
    for name in objects:
        meshes.find(name)
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    chosen = cells.named(options.groups, CONDITIONS, beside=GRID)
    methods = {name: m for name, m in METHODS.items() if name != GRID or GRID in options.groups}
    wanted = {
        (name, condition, method): Cell(
            setting_of(name, COLUMNS, options), METHODS[method], CONDITIONS[condition]
        )
        for name in objects
        for condition in chosen
        for method in methods
    }
    found = cells.run([(cell, seeds) for cell in wanted.values()], options)
    rows = [
        {"object": name, "condition": condition, "method": method, "contact": contact}
        | _row(found[cell], contact)
        | _beside(found[cell], found.get(wanted[name, condition, "default"]), method, contact)
        for (name, condition, method), cell in wanted.items()
        if cell in found
        for contact in cell.method.touches or range(1, cells.TOUCHES + 1)
    ]
    data = write(options, "shipped", rows)
    table = data.with_suffix(".md")
    table.write_text(_table(rows), encoding="utf-8")
    return [data, table]


def _row(results: Results, contact: int) -> dict[str, Any]:
    last = [trial[contact - 1] for trial in results.values()]
    return shares(results, contact) | errors(last, "map_mm") | {"seeds": len(results)}


def _beside(
    grid: Results, default: Results | None, method: str, contact: int
) -> dict[str, float | int | None]:
    """Of the trials that the grid and the default have: how many each alone did not find, how many
    neither did, and how likely chance alone parts them so far."""
    if method != GRID or default is None:
        return {}
    seeds = sorted(grid.keys() & default.keys())
    pairs = [
        (default[seed][contact - 1].succeeded, grid[seed][contact - 1].succeeded) for seed in seeds
    ]
    return {
        "lost_by_default": pairs.count((False, True)),
        "lost_by_grid": pairs.count((True, False)),
        "lost_by_both": pairs.count((False, False)),
        "p_default": p_success(grid, default, contact),
    }


def _table(rows: Sequence[dict[str, Any]]) -> str:
    """Success and silent failures, a line an object and condition, a column a contact."""
    contacts = range(1, cells.TOUCHES + 1)
    lines = [
        "Under 10 mm; converged but off by more than 20 mm, at that contact / at any up to it; of",
        "the grid, which has no status, trials lost by the default alone / the grid alone / both:",
        "",
        f"| object | condition | method | {' | '.join(str(k) for k in contacts)} |",
        "| --- " * (3 + len(contacts)) + "|",
    ]
    of: dict[tuple[str, str, str], dict[int, str]] = {}
    for row in rows:
        key = row["object"], row["condition"], row["method"]
        of.setdefault(key, {})[row["contact"]] = _figures(row)
    lines += [
        "| " + " | ".join([*key, *(mine.get(k, "") for k in contacts)]) + " |"
        for key, mine in of.items()
    ]
    return "\n".join(lines) + "\n"


def _figures(row: dict[str, Any]) -> str:
    found = f"{row['success_rate']:.1%}, "
    if row["method"] == GRID:
        lost = (row.get(f"lost_by_{name}", "?") for name in ("default", "grid", "both"))
        return found + " / ".join(map(str, lost))
    return found + f"{row['silent_failure_rate']:.1%} / {row['silent_so_far_rate']:.1%}"
