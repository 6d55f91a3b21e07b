"""`taxeld-train evaluate works`: will it work? Objects on skins, touch by touch.

What a new user has: the daemon's default filter with the table, which needs no training, on random
touches of the object. Each row says how far off the estimates were after so many touches, and how
many were found, sure and misleading.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_hil.objects import meshes
from taxeld_training.filters import cells, levels
from taxeld_training.filters.cells import TOUCHES, Cell
from taxeld_training.filters.levels import LEVELS, Level
from taxeld_training.filters.methods import TABLED, TouchResult
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.statistics import of_count, rounded
from taxeld_training.objects.setting import OBJECTS

USUAL = ("as assumed=0", "skin=typical", "skin=poor", "sensor mm=2")
NAMES = {"as assumed=0": "exact", "sensor mm=2": "robot errs by 2 mm"}
SEEDS, QUICK_SEEDS = 40, 2


def work_rows(options: Options) -> list[Path]:
    """A row an object, skin and touch.

    Raises:
        SetupError: no such object or cell, or a layout that misses an object.
    """
    objects = (options.objects or OBJECTS)[: 2 if options.quick else None]
    for name in objects:
        meshes.find(name)
    usual = levels.chosen(USUAL)
    table = levels.asked_for(options, LEVELS, usual)
    count = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    wanted = {
        Cell(level.setting(name, options), TABLED, level.conditions): level
        for level in table
        for name in objects
    }
    found = cells.run([(cell, count) for cell in wanted], options)
    rows = [
        _row(cell.setting.object, wanted[cell], touch, list(results.values()))
        for cell, results in found.items()
        for touch in range(1, TOUCHES + 1)
    ]
    return [write(options, "works", rows)]


def _row(
    name: str, level: Level, touch: int, trials: Sequence[Sequence[TouchResult]]
) -> dict[str, Any]:
    after = [trial[touch - 1] for trial in trials]
    middle, most = np.quantile([each.map_mm for each in after], (0.5, 0.9)).round(2).tolist()
    both = sum(each.found and each.sure for each in after)
    return {
        "object": name,
        "skin": NAMES.get(level.name, str(level.level)),
        "touches": touch,
        "trials": len(after),
        "median_mm": middle,
        "q90_mm": most,
        "found": sum(each.found for each in after),
        "sure": sum(each.sure for each in after),
        "found_and_sure": both,
        "found_and_sure_ci": rounded(of_count(both, len(after))),
        "misleading": sum(each.misleading for each in after),
        "touch_cpu_ms": round(float(np.median([each.cpu_ms for each in after])), 2),
    }
