"""`taxeld-train evaluate ablation`: what ships with one constant changed at a time."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from taxeld_training.filters import cells, constants, levels, reliability
from taxeld_training.filters.cells import Results
from taxeld_training.filters.constants import CONSTANTS, Change, Constant
from taxeld_training.jobs import promises
from taxeld_training.jobs.options import Options, check, write
from taxeld_training.jobs.rows import Row, number_of, table

CELLS = (
    "as assumed",
    "skin",
    "nudged mm=2",
    "stuck at 1=2",
    "moved=kidnapped",
    "wrong object=061_foam_brick",
)
SEEDS, QUICK_SEEDS = 40, 1
COLUMNS = ("found_6", "found_and_sure_6", "found_and_sure_8", "misleading", "ece", "ms")


def ablation_rows(options: Options) -> list[Path]:
    """Rows {constant, value, found_6, found_and_sure_6, found_and_sure_8, misleading, ece, ms} over
    all cells, the first of the filter as it ships, and a table of them.

    `found_6` is the share of runs that are found after six contacts; `misleading` is a share of all
    estimates; `ms` is processor time a touch. Runs with a wrong object count in the last three
    alone.

    Raises:
        SetupError: no such object, cell or constant.
    """
    known = reliability.all_levels()
    found = levels.asked_for(options, known, levels.chosen(CELLS, known))
    wanted = reliability.wanted(found, options, QUICK_SEEDS if options.quick else SEEDS)
    changes = [None, *(change for each in _chosen(options.groups) for change in each.changes)]
    for change in filter(None, changes):
        constants.shipped(change.module, change.name)
    done = cells.run(
        [
            (replace(cell, change=change), count)
            for change in changes
            for (_, cell), count in wanted.items()
        ],
        options,
    )
    rows = [
        _row(change, mine)
        for change in changes
        for mine in [[results for cell, results in done.items() if cell.change == change]]
        if mine
    ]
    return [write(options, "ablation", rows, _table(rows))]


def _chosen(names: Sequence[str]) -> list[Constant]:
    """The constants by name; all if none is named."""
    check("--groups", names, [constant.name for constant in CONSTANTS])
    return [constant for constant in CONSTANTS if not names or constant.name in names]


def _row(change: Change | None, found: Sequence[Results]) -> dict[str, Any]:
    given = reliability.promised(found)
    figures = promises.kept(given)
    sixth = given.of_object & (given.contact == 6)
    taken = [each.cpu_ms for results in found for run in results.values() for each in run]
    return {
        "constant": "as it ships" if change is None else f"{change.module}.{change.name}",
        "value": None if change is None else change.value,
        "found_6": round(float(given.found[sixth].mean()), 4) if sixth.any() else None,
        "found_and_sure_6": figures["found_and_sure_6"],
        "found_and_sure_8": figures["found_and_sure_8"],
        "misleading": round(figures["misleading"] / len(given), 5),
        "ece": figures["ece"],
        "ms": round(math.fsum(taken) / len(taken), 3),
        "runs": sum(map(len, found)),
    }


def _table(rows: Sequence[Row]) -> str:
    heads: dict[str, Callable[[Row], str]] = {
        "constant": lambda row: str(row["constant"]),
        "value": lambda row: "" if row["value"] is None else str(row["value"]),
    }
    return table(rows, heads, {key: number_of(key) for key in COLUMNS})
