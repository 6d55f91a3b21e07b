"""The table of conditions: every factor that differs from what a filter assumes, and its levels.

All experiments on filters take their trials from this table. `--cells` names factors (noise) or
single levels (moved=5).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from taxeld.errors import SetupError
from taxeld_hil.jobs import layout_name
from taxeld_hil.objects import meshes
from taxeld_training.filters.cells import COLUMNS, TOUCHES, setting_of
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.jobs.options import Options
from taxeld_training.objects import DEPTH_MAX_M
from taxeld_training.objects.setting import Setting, ring

SYMMETRIC = ("002_master_chef_can", "024_bowl", "061_foam_brick")
UNMET = (  # no constant was set on them; of several sizes and shapes, chosen before any figure
    "004_sugar_box",
    "005_tomato_soup_can",
    "010_potted_meat_can",
    "011_banana",
    "013_apple",
    "022_windex_bottle",
    "036_wood_block",
    "053_mini_soccer_ball",
    "065-j_cups",
    "077_rubiks_cube",
)
FOAMS = ("", "typical", "poor")  # exact, and soft skins of the harness
BESIDE_THE_MAP = ("nudged mm", "lengths")  # factors that run only where --cells names them


@dataclass(frozen=True)
class Lengths:
    """Lengths of an object and a skin that are not the usual ones."""

    across_m: float = 0.0  # the object's larger side from above; 0: as it is
    radius_m: float = 0.04
    pitch_m: float = 0.015
    columns: int = COLUMNS
    depth_max_m: float = DEPTH_MAX_M
    scale: float = 1.0  # factor of all these lengths: the same world, smaller or larger

    def of(self, name: str, seed: int = 0) -> Setting:
        """The object `name` with these lengths."""
        scale = self.scale
        if self.across_m:
            scale *= self.across_m / float(meshes.load(meshes.find(name)[0]).extents[:2].max())
        skin = ring(self.columns, self.scale * self.radius_m, self.scale * self.pitch_m)
        depth_max_m = self.scale * self.depth_max_m
        return Setting(name, skin, 0, seed=seed, scale=scale, depth_max_m=depth_max_m)


@dataclass(frozen=True)
class Level:
    """One factor that differs from what the filter assumes, and by how much."""

    factor: str
    level: float | str
    conditions: TrialConditions = field(default_factory=TrialConditions)
    columns: int = COLUMNS
    particles: int = 0  # particles of the filter; 0: the method's own number
    touched: str = ""  # object of the trials; empty: the one that the filter assumes
    objects: tuple[str, ...] = ()  # objects of the filter, in place of the experiment's
    seeds: float = 1.0  # factor of a cell's number of trials
    lengths: Lengths | None = None  # lengths of object and skin; no model is trained for them
    layout: str = ""  # a skin, as `skin.layout` has it, in place of the rings

    @property
    def name(self) -> str:
        """The level as `--cells` names it."""
        level = self.level if isinstance(self.level, str) else f"{self.level:g}"
        return f"{self.factor}={level}"

    def setting(self, name: str, options: Options) -> Setting:
        """The object `name` on this level's skin."""
        if self.lengths is not None:
            return self.lengths.of(name, options.seed)
        setting = setting_of(name, self.columns, options)
        return replace(setting, skin=self.layout, columns=0) if self.layout else setting


def _levels(factor: str, key: str, values: Sequence[float], unit: float = 1.0) -> list[Level]:
    """Levels of the condition `key`; `unit` is the unit of `values` in that of the condition."""
    given: list[dict[str, Any]] = [{key: type(value)(value * unit)} for value in values]
    return [
        Level(factor, value, TrialConditions(**each))
        for value, each in zip(values, given, strict=True)
    ]


def _even(pitch_m: float) -> Lengths:
    """A ring whose taxels are as far apart around it as along it."""
    columns = round(2.0 * math.pi * Lengths.radius_m / pitch_m)
    return Lengths(pitch_m=pitch_m, columns=columns)


LEVELS = (
    Level("as assumed", 0),
    *_levels("noise", "sigma", (0.04, 0.08, 0.15)),
    *_levels("gain spread", "gain_cv", (0.0, 0.3, 0.5)),
    *_levels("dead share", "dead_share", (0.2, 0.4, 0.6)),
    *_levels("dead modules", "dead_modules", (2, 4)),
    *_levels("stuck at 1", "stuck", (1, 2, 4)),
    *(Level("stuck at 0", n, TrialConditions(stuck=n, stuck_at=0.0)) for n in (4, 16)),
    *_levels("drift", "drift", (0.05, 0.1, 0.2)),
    *(Level("columns", columns, columns=columns) for columns in (8, 32, 64)),
    *(Level("skin", name, TrialConditions(skin=name)) for name in ("typical", "poor")),
    *_levels("depth", "depth", (1.5, 2.0)),
    *_levels("sensor mm", "sensor_sd_m", (2.0, 5.0, 10.0), 1e-3),
    *_levels("sensor deg", "sensor_sd_rad", (2.0, 5.0), np.pi / 180.0),
    *_levels("nudged mm", "nudged_m", (1.0, 2.0), 1e-3),
    *(
        Level("moved", mm, TrialConditions(pushed_m=1e-3 * mm, pushed_rad=np.deg2rad(0.3 * mm)))
        for mm in (2.0, 5.0, 25.0)
    ),
    Level("moved", "kidnapped", TrialConditions(kidnapped_after=TOUCHES // 2), seeds=2.0),
    *(Level("wrong object", name, touched=name) for name in UNMET),
    *_levels("two objects", "both", (1, 4, 8)),
    *(Level("particles", n, particles=n) for n in (20, 50, 500, 2000)),
    Level("one side", "90°", TrialConditions(one_side=True)),
    *(
        Level("scans", f"{scans}x{5 * columns}", TrialConditions(scans=scans, slip_m=1e-3), columns)
        for scans, columns in ((1, 16), (5, 16), (20, 16), (20, 64))
    ),
    *(Level("symmetric", name, objects=(name,)) for name in SYMMETRIC),
    *(
        Level("lengths", name, lengths=lengths)
        for name, lengths in {
            "usual": Lengths(),
            "object 30 mm": Lengths(across_m=0.03),
            "object 300 mm": Lengths(across_m=0.3),
            "all by 1/4": Lengths(scale=0.25),
            "all by 2": Lengths(scale=2.0),
            "radius 20 mm": Lengths(radius_m=0.02),
            "radius 80 mm": Lengths(radius_m=0.08),
            "depth 2 mm": Lengths(depth_max_m=0.002),
            "depth 10 mm": Lengths(depth_max_m=0.01),
            "pitch 8 mm": _even(0.008),
            "pitch 25 mm": _even(0.025),
        }.items()
    ),
)


def asked_for(options: Options, levels: Sequence[Level], usual: Sequence[Level]) -> list[Level]:
    """The levels of an experiment: what `--cells` names of `levels`, or the `usual` ones, of which
    a quick run takes the last of each factor; each with those of `--layout`. `--objects` leaves out
    levels of other objects.

    Raises:
        SetupError: there is no such factor or level.
    """
    others = [on_layout(each, foam) for each in options.layouts if each for foam in FOAMS]
    if options.cells:
        known = [each for each in levels if _is_open(each, options)]
        return chosen(options.cells, [*known, *others])
    usual = [each for each in usual if "" in options.layouts and _is_open(each, options)]
    asked = [*usual, *others]
    if options.quick:
        return list({(level.factor, level.layout): level for level in asked}.values())
    return asked


def on_layout(layout: str, foam: str) -> Level:
    """A layout in place of the rings, with a foam of the harness or, if it is "", exact."""
    name = f"{layout_name(layout)}, {foam or 'exact'}"
    return Level("layout", name, TrialConditions(skin=foam), layout=layout)


def _is_open(level: Level, options: Options) -> bool:
    return not (level.objects and options.objects)


def chosen(names: Sequence[str], levels: Sequence[Level] = LEVELS) -> list[Level]:
    """The levels that `names` name: all of a factor, or one as FACTOR=LEVEL.

    Raises:
        SetupError: there is no such factor or level.
    """
    of: dict[str, list[str]] = {}
    for level in levels:
        of.setdefault(level.factor, []).append(level.name)
    for name in names:
        factor, _, _ = name.partition("=")
        there = of.get(factor, of)
        if name not in there and name not in of:
            raise SetupError(f"--cells: no '{name}' here; there are {', '.join(there)}")
    return [level for level in levels if level.factor in names or level.name in names]
