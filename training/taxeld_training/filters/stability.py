"""`taxeld-train evaluate stability`: few filters over the whole table of conditions, after the last
contact: where they fail, and whether they report it.

The grid filter, which runs where `--groups` names it, is the limit: what it does not find, no
filter of its likelihood finds.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_hil.integrity import FOUND_MM
from taxeld_hil.objects import meshes
from taxeld_training.filters import cells, levels
from taxeld_training.filters.cells import TOUCHES, Cell, Results
from taxeld_training.filters.levels import BESIDE_THE_MAP, LEVELS, Level
from taxeld_training.filters.methods import GRID, SHIPPED, TABLED, Method, claims
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.statistics import p_share, share
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained
from taxeld_training.samplers.trained import DENSITY

FOUND_SHARE = 0.1  # error under which an object is found, as a share of its mean diameter
METHODS = (
    SHIPPED,
    TABLED,
    Method(DENSITY, "paper", 100),
    Method("projection", "paper", 100),
)
LIMIT = Method(GRID, touches=(TOUCHES,))  # a look after each touch would take minutes a trial
OBJECTS = ("003_cracker_box", "025_mug")
SEEDS, QUICK_SEEDS = 100, 3


def stability_rows(options: Options) -> list[Path]:
    """Rows, table and map of `evaluate stability`: a row an object, level and method.

    Raises:
        SetupError: no such object, group or cell.
    """
    from taxeld_training import charts  # noqa: PLC0415  # matplotlib is not needed to train

    usual = [level for level in LEVELS if level.factor not in BESIDE_THE_MAP]
    table = levels.asked_for(options, LEVELS, usual)
    objects = options.objects or OBJECTS
    for name in objects:
        meshes.find(name)
    named = cells.chosen([*METHODS, LIMIT], options.groups)
    methods = named if options.groups else METHODS
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    wanted = dict.fromkeys(  # methods may differ in nothing but particles, which a level may set
        (level, cell_of(level, placed(method, setting, level), setting))
        for level in table
        for name in level.objects or objects
        for setting in [level.setting(name, options)]
        for method in methods
        if not (level.lengths and trained.is_learned(method.proposal, setting))
    )
    done = cells.run([(cell, round(level.seeds * seeds)) for level, cell in wanted], options)
    found = [
        _row(level, cell, done[cell], done.get(shipped))
        for level, cell in wanted
        if cell in done
        for shipped in [cell_of(level, placed(SHIPPED, cell.setting, level), cell.setting)]
    ]
    # chosen cells do not take the place of the whole table's rows
    data = write(options, "stability_cells" if options.cells else "stability", found)
    charts.failures(found, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def placed(method: Method, setting: Setting, level: Level) -> Method:
    """A method on a level: nothing is trained for the layouts of `--layout`, so the table proposes
    where no bundle is shipped."""
    untrained = level.layout and trained.is_learned(method.proposal, setting)
    return replace(method, proposal="table") if untrained else method


def cell_of(level: Level, method: Method, setting: Setting) -> Cell:
    """A method's trials under the conditions of a level."""
    if level.particles and method.particles:
        method = replace(method, particles=level.particles, particles_max=0)
    return Cell(setting, method, level.conditions, level.touched)


def _row(level: Level, cell: Cell, results: Results, shipped: Results | None) -> dict[str, Any]:
    """The row of a cell; `shipped` has the trials of what ships under the same
    conditions. Errors of other lengths are in hundredths of the object's mean diameter."""
    method = cell.method
    of_lengths: dict[str, float] = {}
    if level.lengths:
        diameter_mm = 2e3 * trained.model_of(cell.setting).scene.mean_radius
        of_lengths = {"diameter_mm": round(diameter_mm, 1)}
        unit = FOUND_MM / (FOUND_SHARE * diameter_mm)
        results = {
            seed: [
                each._replace(map_mm=unit * each.map_mm, radius_m=unit * each.radius_m)
                for each in trial
            ]
            for seed, trial in results.items()
        }
    median_mm = float(np.median([trial[TOUCHES - 1].map_mm for trial in results.values()]))
    return {
        "object": cell.setting.object,
        "factor": level.factor,
        "level": level.level,
        "proposal": method.proposal,
        "injection": method.injection,
        "particles": method.particles,
        "contact": TOUCHES,
        **of_lengths,
        "median_mm": None if np.isnan(median_mm) else round(median_mm, 3),
        **shares(results, TOUCHES),
        "p_shipped": p_shipped(results, shipped, TOUCHES),
        "particles_max": method.particles_max or method.particles,
        "seeds": len(results),
    }


def shares(results: Results, contact: int) -> dict[str, float | list[float] | None]:
    """Shares of trials whose estimates after a contact, counted from 1, are found, sure, and
    misleading, after it or after any up to it; the last three are None for a filter that publishes
    no p. Each `_ci` is the interval of the figure before it.

    Where another object is touched than the filter assumes none is found, and one that is sure
    misleads.
    """
    trials = [trial[:contact] for trial in results.values()]
    of, last = claims(trials), contact - 1
    told = slice(None if trials[0][last].status is not None else 0)
    return {
        **share("found", of.found[:, last], "_rate"),
        "sure_rate": share("sure", of.sure[told, last])["sure"],
        **share("misleading", of.misleading[told, last], "_rate"),
        **share("misleading_so_far", of.misleading[told].any(axis=1), "_rate"),
    }


def p_shipped(mine: Results, shipped: Results | None, contact: int) -> float | None:
    """How likely chance alone parts a method so far from the one that ships, after a contact of the
    trials that both have; None where what ships was not run."""
    if shipped is None:
        return None
    seeds = sorted(mine.keys() & shipped.keys())
    found = ([of[seed][contact - 1].found for seed in seeds] for of in (mine, shipped))
    return round(p_share(*found), 6)
