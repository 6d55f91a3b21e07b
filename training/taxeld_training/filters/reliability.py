"""`taxeld-train evaluate reliability`: whether the published `p` and `radius_m` keep their word.

What ships is run over the whole table of conditions, objects of other lengths, pairs of an object
and another that is taken for it, and other layouts. Half of the cells were looked
at while the filter was built (`tuned`). The other half was not: it tells what a user will meet.
Where no bundle is shipped the table proposes, as nothing is trained for this.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_hil.objects import meshes
from taxeld_training.filters import cells, levels
from taxeld_training.filters.cells import Cell, Results
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.levels import LEVELS, UNMET, Level
from taxeld_training.filters.methods import SHIPPED, TABLED, Method, claims
from taxeld_training.filters.stability import OBJECTS, cell_of
from taxeld_training.jobs import promises
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.promises import Promises
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained
from taxeld_training.samplers.trained import DENSITY

SEEDS, QUICK_SEEDS = 40, 2
MET = (  # objects that were taken for others while the filter was built
    "002_master_chef_can",
    "006_mustard_bottle",
    "016_pear",
    "019_pitcher_base",
    "021_bleach_cleanser",
    "024_bowl",
    "035_power_drill",
    "061_foam_brick",
)
ALL, TUNED, NOT_TUNED, SOFT, WRONG = "all", "tuned", "not tuned", "soft skin", "wrong object"
CURVES = (TUNED, NOT_TUNED, SOFT, WRONG)  # cells whose estimates have a curve together
GROUPS = (ALL, *CURVES)


def reliability_rows(options: Options) -> list[Path]:
    """Rows and picture of `evaluate reliability`. First figures over many cells: all, each
    half, soft skins, wrong objects; then those of each cell.

    Raises:
        SetupError: no such object, layout or cell.
    """
    from taxeld_training import charts  # noqa: PLC0415  # matplotlib is not needed to train

    table = levels.asked_for(options, all_levels(), all_levels())
    counts = wanted(table, options, QUICK_SEEDS if options.quick else SEEDS)
    done = cells.run([(cell, count) for (_, cell), count in counts.items()], options)
    found = {(level, cell): done[cell] for level, cell in counts if cell in done}
    groups = {
        name: promised(results for key, results in found.items() if name in groups_of(*key))
        for name in GROUPS
    }
    over = [_group_row(name, given) for name, given in groups.items() if len(given)]
    single = [_cell_row(level, cell, results) for (level, cell), results in found.items()]
    name = "reliability_cells" if options.cells else "reliability"
    data = write(options, name, [*over, *single])
    curves = [row for row in over if row["over"] in CURVES]
    charts.reliability(curves, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def all_levels() -> list[Level]:
    """The levels of the table, and each wrong object on each foam."""
    found = [*LEVELS]
    for skin in levels.FOAMS:
        factor = f"{WRONG} on {skin}" if skin else WRONG
        wrong = (Level(factor, name, _on(skin), touched=name) for name in (*MET, *UNMET))
        found += [level for level in wrong if level not in found]
    return found


def wanted(table: Sequence[Level], options: Options, seeds: int) -> dict[tuple[Level, Cell], int]:
    """The cells of what ships on levels, and how many trials of each: `seeds`, or as `--seeds` has
    it. No object is taken for itself."""
    objects = options.objects or OBJECTS
    for name in objects:
        meshes.find(name)
    return {
        (level, cell_of(level, method_of(setting), setting)): round(
            level.seeds * (options.seeds or seeds)
        )
        for level in table
        for name in level.objects or objects
        for setting in [level.setting(name, options)]
        if level.touched != name
    }


def promised(found: Iterable[Results]) -> Promises:
    """All estimates of the runs of cells."""
    runs = [run for results in found for run in results.values()]
    if not runs:
        none = np.empty(0)
        return Promises(none, none, none, none.astype(np.intp))
    of = claims(runs)
    contact = np.tile(np.arange(of.p.shape[1]) + 1, len(runs))
    return Promises(of.p.ravel(), of.radius_mm.ravel(), of.error_mm.ravel(), contact)


def method_of(setting: Setting) -> Method:
    """What ships; the table proposes where no density is shipped."""
    return TABLED if trained.is_learned(DENSITY, setting) else SHIPPED


def is_tuned(level: Level, cell: Cell) -> bool:
    """Whether the cell was looked at while the filter was built. The rule is fixed: whoever tunes
    on a cell of the other half moves it to this one."""
    if level.lengths or level.layout or level.touched in UNMET:
        return False
    return bool(level.objects) or cell.setting.object in OBJECTS


def groups_of(level: Level, cell: Cell) -> list[str]:
    """The groups that a cell counts in, of `GROUPS`."""
    half = TUNED if is_tuned(level, cell) else NOT_TUNED
    if level.touched:
        return [ALL, half, WRONG]
    return [ALL, half, *([SOFT] if level.conditions.skin else [])]


def _group_row(name: str, given: Promises) -> dict[str, Any]:
    bins = promises.reliability(given.p, given.found)
    return {"over": name, **promises.kept(given), "reliability": bins}


def _cell_row(level: Level, cell: Cell, results: Results) -> dict[str, Any]:
    return {
        "object": cell.setting.object,
        "factor": level.factor,
        "level": level.level,
        "touched": level.touched,
        "skin": level.conditions.skin or "exact",
        "tuned": is_tuned(level, cell),
        "proposal": cell.method.proposal,
        **promises.kept(promised([results])),
        "seeds": len(results),
    }


def _on(skin: str) -> TrialConditions:
    return TrialConditions(skin=skin)
