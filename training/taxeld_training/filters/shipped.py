"""`taxeld-train evaluate shipped`: the configuration that ships, contact by contact, where all is
exact, where the robot errs, and where the object gives way."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_training.filters import cells
from taxeld_training.filters.cells import COLUMNS, Cell, Results, setting_of
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.figures import errors, shares
from taxeld_training.filters.methods import SHIPPED
from taxeld_training.jobs.options import Options, write
from taxeld_training.objects import meshes

OBJECTS = ("003_cracker_box", "025_mug")
SEEDS, QUICK_SEEDS = 100, 10
CONDITIONS = {
    "exact": Conditions(),
    "robot 2 mm": Conditions(sensor_sd_m=0.002),
    "nudged 1 mm": Conditions(nudged_m=0.001),
    "nudged 2 mm": Conditions(nudged_m=0.002),
    "moved 2 mm": Conditions(pushed_m=0.002, pushed_rad=float(np.deg2rad(0.6))),
}


def run(options: Options) -> list[Path]:
    """Rows {object, condition, contact, map_mm, seeds and what `figures.shares` has}, and a table
    of them."""
    objects = options.objects or OBJECTS
    for name in objects:
        meshes.find(name)
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    wanted = {
        (name, condition): Cell(setting_of(name, COLUMNS, options), SHIPPED, given)
        for name in objects
        for condition, given in CONDITIONS.items()
        if not options.groups or condition in options.groups
    }
    found = cells.run([(cell, seeds) for cell in wanted.values()], options)
    rows = [
        {"object": name, "condition": condition, "contact": contact} | _row(found[cell], contact)
        for (name, condition), cell in wanted.items()
        if cell in found
        for contact in range(1, cells.TOUCHES + 1)
    ]
    data = write(options, "shipped", rows)
    table = data.with_suffix(".md")
    table.write_text(_table(rows), encoding="utf-8")
    return [data, table]


def _row(results: Results, contact: int) -> dict[str, Any]:
    last = [trial[contact - 1] for trial in results.values()]
    return shares(results, contact) | errors(last, "map_mm") | {"seeds": len(results)}


def _table(rows: Sequence[dict[str, Any]]) -> str:
    """Success and silent failures, a line an object and condition, a column a contact."""
    contacts = range(1, cells.TOUCHES + 1)
    lines = [
        "Under 10 mm; converged but off by more than 20 mm, at that contact / at any up to it:",
        "",
        f"| object | condition | {' | '.join(str(k) for k in contacts)} |",
        "| --- " * (2 + len(contacts)) + "|",
    ]
    for name, condition in dict.fromkeys((row["object"], row["condition"]) for row in rows):
        mine = [row for row in rows if (row["object"], row["condition"]) == (name, condition)]
        lines.append(
            "| "
            + " | ".join([name, condition, *(
                f"{row['success_rate']:.1%}, {row['silent_failure_rate']:.1%}"
                f" / {row['silent_so_far_rate']:.1%}"
                for row in mine
            )])
            + " |"
        )  # fmt: skip
    return "\n".join(lines) + "\n"
