"""`taxeld-train evaluate advice`: how many touches it takes, by who says where they are made.

All guides have the same object at the same place and the same first touch; an approach that meets
nothing counts as a touch. The table proposes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.errors import SetupError
from taxeld_training.filters import cells
from taxeld_training.filters.cells import COLUMNS, Cell, setting_of
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.guides import ADVICE, ANY, GUIDES, RANDOM
from taxeld_training.filters.methods import TABLED, TouchResult, claims
from taxeld_training.filters.touches import FOAMS
from taxeld_training.jobs.options import Options, write
from taxeld_training.objects.setting import OBJECTS

SEEDS, QUICK_SEEDS = 40, 1
BLOCK = 5  # seeds a job
MANY = "025_mug", "035_power_drill"  # objects whose touches tell little: SEEDS of each
FEWER = 0.5  # factor of the number of trials with others
CELLS = {
    "exact": FOAMS["exact"],
    "typical": FOAMS["typical"],
    "robot 1 mm": TrialConditions(sensor_sd_m=0.001),
}
ALL_CELLS = (*MANY, "003_cracker_box")  # objects of all cells; the others are of exact readings


def advice_rows(options: Options) -> list[Path]:
    """Rows of `evaluate advice`.

    Raises:
        SetupError: no such object, guide or cell.
    """
    for option, names, known in (
        ("groups", options.groups, GUIDES),
        ("cells", options.cells, CELLS),
    ):
        for name in set(names).difference(known):
            raise SetupError(f"--{option}: no '{name}'; there are {', '.join(known)}")
    named = wanted(options)
    counts = {cell: count for cell, (_, count) in named.items()}
    done = cells.run(counts.items(), options, BLOCK)
    rows = [_row(cell, named[cell][0], [*results.values()]) for cell, results in done.items()]
    return [write(options, "advice", rows)]


def wanted(options: Options) -> dict[Cell, tuple[str, int]]:
    """Which trials, the names of their cells, and how many of each."""
    count = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    found = {}
    for name in options.objects or (*MANY, *(name for name in OBJECTS if name not in MANY)):
        is_many, setting = name in MANY, setting_of(name, COLUMNS, options)
        for cell in CELLS if name in ALL_CELLS else ("exact",):
            for guide in (ANY, RANDOM, ADVICE) if is_many else (RANDOM, ADVICE):
                if guide in (options.groups or GUIDES) and cell in (options.cells or CELLS):
                    trials = count if is_many else max(round(FEWER * count), 1)
                    of = Cell(setting, TABLED, CELLS[cell], guide=guide)
                    found[of] = cell, trials
    return found


def _row(cell: Cell, name: str, trials: Sequence[Sequence[TouchResult]]) -> dict[str, Any]:
    """Shares after each touch, and what an advice costs."""
    row: dict[str, Any] = {"object": cell.setting.object, "cell": name, "guide": cell.guide}
    row |= claims(trials).by_touch()
    spent_ms = [touch.guide_ms for trial in trials for touch in trial if touch.guide_ms]
    if spent_ms:
        row["advice_ms"] = round(float(np.median(spent_ms)), 2)
        row["advice_ms_95"] = round(float(np.percentile(spent_ms, 95.0)), 2)
    return row
