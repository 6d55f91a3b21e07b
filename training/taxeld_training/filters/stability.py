"""`taxeld-train evaluate stability`: where methods fail, by factor, and whether they report it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_training.filters import cells
from taxeld_training.filters.cells import COLUMNS, TOUCHES, Cell, Results, setting_of
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.figures import p_success, shares
from taxeld_training.filters.methods import SHIPPED, Method
from taxeld_training.filters.soft_skin import SKINS
from taxeld_training.jobs.options import Options, write
from taxeld_training.objects import meshes
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers.trained import DENSITY

OBJECTS = ("003_cracker_box", "025_mug")
SYMMETRIC = ("002_master_chef_can", "024_bowl", "061_foam_brick")
SEEDS, QUICK_SEEDS = 100, 3
METHODS = (
    SHIPPED,  # the others are compared with it
    replace(SHIPPED, proposal="table"),
    Method(DENSITY, "paper", 100),
    Method("projection", "paper", 100),
)


@dataclass(frozen=True)
class Level:
    """One factor that differs from what the filter assumes, and by how much."""

    factor: str
    level: float | str
    conditions: Conditions = field(default_factory=Conditions)
    columns: int = COLUMNS
    particles: int = 0  # 0: the method's own
    touched: str = ""  # object of the trials; empty: the one that the filter assumes
    objects: tuple[str, ...] = ()  # the filter assumes, in place of the experiment's
    seeds: float = 1.0  # times a cell's trials


def _levels(factor: str, key: str, values: Sequence[float], unit: float = 1.0) -> list[Level]:
    """Levels of the condition `key`; `unit` is the unit of `values` in that of the condition."""
    given: list[dict[str, Any]] = [{key: type(value)(value * unit)} for value in values]
    return [
        Level(factor, value, Conditions(**each)) for value, each in zip(values, given, strict=True)
    ]


LEVELS = (
    Level("as assumed", 0),
    *_levels("noise", "sigma", (0.04, 0.08, 0.15)),
    *_levels("gain spread", "gain_cv", (0.0, 0.3, 0.5)),
    *_levels("dead share", "dead_share", (0.2, 0.4, 0.6)),
    *_levels("dead modules", "dead_modules", (2, 4)),
    *_levels("stuck at 1", "stuck", (1, 2, 4)),
    *(Level("stuck at 0", n, Conditions(stuck=n, stuck_at=0.0)) for n in (4, 16)),
    *_levels("drift", "drift", (0.05, 0.1, 0.2)),
    *(Level("columns", columns, columns=columns) for columns in (8, 32, 64)),
    *(Level("skin", name, Conditions(skin=name)) for name in SKINS),
    *_levels("depth", "depth", (1.5, 2.0)),
    *_levels("sensor mm", "sensor_sd_m", (2.0, 5.0, 10.0), 1e-3),
    *_levels("sensor deg", "sensor_sd_rad", (2.0, 5.0), np.pi / 180.0),
    *(
        Level("moved", mm, Conditions(pushed_m=1e-3 * mm, pushed_rad=np.deg2rad(0.3 * mm)))
        for mm in (2.0, 5.0, 25.0)
    ),
    Level("moved", "kidnapped", Conditions(kidnapped_after=TOUCHES // 2), seeds=2.0),
    *(
        Level("wrong object", name, touched=name)
        for name in ("061_foam_brick", "002_master_chef_can", "035_power_drill")
    ),
    *_levels("two objects", "both", (1, 4, 8)),
    *(Level("particles", n, particles=n) for n in (20, 50, 500, 2000)),
    Level("one side", "90°", Conditions(one_side=True)),
    *(
        Level("scans", f"{scans}x{5 * columns}", Conditions(scans=scans, slip_m=1e-3), columns)
        for scans, columns in ((1, 16), (5, 16), (20, 16), (20, 64))
    ),
    *(Level("symmetric", name, objects=(name,)) for name in SYMMETRIC),
)


def run(options: Options) -> list[Path]:
    """Rows, table and map."""
    from taxeld_training.charts import stability_map  # noqa: PLC0415  # matplotlib is not needed to train

    found = rows(options)
    data = write(options, "stability", found)
    stability_map.table(found, data.with_suffix(".md"))
    stability_map.draw(found, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def rows(options: Options) -> list[dict[str, Any]]:
    """A row an object, level and method."""
    objects = options.objects or OBJECTS
    methods = cells.chosen(METHODS, options.groups)
    for name in objects:
        meshes.find(name)
    levels = [level for level in LEVELS if not level.objects or objects == OBJECTS]
    if options.quick:  # the last level of each factor
        levels = list({level.factor: level for level in levels}.values())
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    wanted = [
        (level, cell_of(level, method, setting_of(name, level.columns, options)))
        for level in levels
        for name in level.objects or objects
        for method in methods
    ]
    found = cells.run([(cell, round(level.seeds * seeds)) for level, cell in wanted], options)
    first = {
        (cell.conditions, cell.setting, cell.touched, level.particles): cell
        for level, cell in reversed(wanted)
    }  # by the first of the methods
    return [
        _row(level, cell, found[cell], found.get(
            first[cell.conditions, cell.setting, cell.touched, level.particles]))
        for level, cell in wanted
        if cell in found
    ]  # fmt: skip


def cell_of(level: Level, method: Method, setting: Setting) -> Cell:
    if level.particles:
        method = replace(method, particles=level.particles, particles_max=0)
    return Cell(setting, method, level.conditions, level.touched)


def _row(level: Level, cell: Cell, results: Results, to: Results | None) -> dict[str, Any]:
    """Of a cell; `to`: the first method's trials under the same conditions."""
    return {
        "object": cell.setting.object,
        "factor": level.factor,
        "level": level.level,
        "proposal": cell.method.proposal,
        "injection": cell.method.injection,
        **shares(results, TOUCHES),
        "p_first": None if to is None else p_success(results, to, TOUCHES),
        "seeds": len(results),
    }
