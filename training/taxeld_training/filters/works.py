"""`taxeld-train evaluate works`: will it work? Objects on skins, touch by touch.

What a new user has: the daemon's default filter with the table, which needs no training, on random
touches of the object. Each row says how far off the estimates were after so many touches, and how
many were found, sure and misleading.
"""

from pathlib import Path

from taxeld_hil.objects import meshes
from taxeld_training.filters import cells, levels
from taxeld_training.filters.cells import Cell
from taxeld_training.filters.levels import LEVELS
from taxeld_training.filters.methods import TABLED, claims
from taxeld_training.jobs.options import Options, write
from taxeld_training.objects.setting import OBJECTS

USUAL = ("as assumed=0", "skin=typical", "skin=poor", "sensor mm=2")
NAMES = {"as assumed=0": "exact", "sensor mm=2": "robot errs by 2 mm"}
SEEDS, QUICK_SEEDS = 40, 2


def work_rows(options: Options) -> list[Path]:
    """A row an object and skin.

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
        {"object": cell.setting.object, "skin": NAMES.get(level.name, str(level.level))}
        | claims(results.values()).by_touch()
        for cell, results in found.items()
        for level in [wanted[cell]]
    ]
    return [write(options, "works", rows)]
