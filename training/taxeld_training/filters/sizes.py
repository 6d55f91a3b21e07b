"""`taxeld-train evaluate sizes`: objects, skins and full scales of other lengths than the usual.

Nothing is trained: samples come from the table. An object is found where it is off by less than a
tenth of its mean diameter, which is 10 mm for the usual ones, and a failure is silent where a
converged one is off by more than a fifth.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_training.filters import cells
from taxeld_training.filters.cells import COLUMNS, TOUCHES, Cell, Results
from taxeld_training.filters.figures import share
from taxeld_training.filters.methods import SHIPPED
from taxeld_training.jobs.options import Options, write
from taxeld_training.objects import meshes
from taxeld_training.objects.setting import DEPTH_MAX_M, Setting, Sized, ring
from taxeld_training.samplers import trained

OBJECTS = ("003_cracker_box", "025_mug")
SEEDS, QUICK_SEEDS = 12, 2
FOUND, SILENT = 0.1, 0.2  # of the mean diameter
METHOD = replace(SHIPPED, proposal="table")


@dataclass(frozen=True)
class Lengths:
    """Of an object and a skin."""

    across_m: float = 0.0  # the object's larger side from above; 0: as it is
    radius_m: float = 0.04
    pitch_m: float = 0.015
    columns: int = COLUMNS
    depth_max_m: float = DEPTH_MAX_M
    all: float = 1.0  # times each of these: the same world, seen from nearer or farther

    def of(self, name: str) -> Setting:
        scale = self.all
        if self.across_m:
            scale *= self.across_m / float(meshes.load(meshes.find(name)[0]).extents[:2].max())
        skin = ring(self.columns, self.all * self.radius_m, self.all * self.pitch_m)
        return Sized(name, skin, self.columns, scale=scale, depth_max_m=self.all * self.depth_max_m)


def _even(pitch_m: float) -> Lengths:
    """As far around as above each other."""
    return Lengths(pitch_m=pitch_m, columns=round(2.0 * math.pi * Lengths.radius_m / pitch_m))


CASES = {
    "usual": Lengths(),
    "object 30 mm": Lengths(across_m=0.03),
    "object 300 mm": Lengths(across_m=0.3),
    "all by 1/4": Lengths(all=0.25),
    "all by 2": Lengths(all=2.0),
    "radius 20 mm": Lengths(radius_m=0.02),
    "radius 80 mm": Lengths(radius_m=0.08),
    "depth 2 mm": Lengths(depth_max_m=0.002),
    "depth 10 mm": Lengths(depth_max_m=0.01),
    "pitch 8 mm": _even(0.008),
    "pitch 25 mm": _even(0.025),
}


def run(options: Options) -> list[Path]:
    """Rows {object, lengths, diameter_mm, error (of the diameter), seeds, and shares found,
    converged, failed silently with their intervals}, and a table of them.

    Raises:
        SetupError: no such lengths, or no such object.
    """
    objects = options.objects or OBJECTS
    for name in objects:
        meshes.find(name)
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    wanted = {
        (name, case): Cell(CASES[case].of(name), METHOD)
        for name in objects
        for case in cells.named(options.groups, CASES)
    }
    found = cells.run([(cell, seeds) for cell in wanted.values()], options)
    rows = [
        {"object": name, "lengths": case} | _row(cell.setting, found[cell])
        for (name, case), cell in wanted.items()
        if cell in found
    ]
    data = write(options, "sizes", rows)
    table = data.with_suffix(".md")
    table.write_text(_table(rows), encoding="utf-8")
    return [data, table]


def _row(setting: Setting, results: Results) -> dict[str, Any]:
    diameter_mm = 2e3 * trained.model_of(setting).scene.mean_radius
    last = [trial[-1] for trial in results.values()]
    off = [result.map_mm / diameter_mm for result in last]
    silent = [result.converged and not e <= SILENT for result, e in zip(last, off, strict=True)]
    return {
        "diameter_mm": round(diameter_mm, 1),
        "error": round(float(np.median(off)), 4),
        **share("success", [e < FOUND for e in off]),
        **share("converged", [result.converged for result in last]),
        **share("silent_failure", silent),
        "seeds": len(results),
    }


def _table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [
        f"After {TOUCHES} touches. Found: off by less than {FOUND:.0%} of the mean diameter; ",
        f"silent: converged, and off by more than {SILENT:.0%}.",
        "",
        "| object | lengths | mean diameter | median error | found | converged | silent |",
        "| --- " * 7 + "|",
    ]
    lines += [
        f"| {row['object']} | {row['lengths']} | {row['diameter_mm']:.0f} mm | {row['error']:.1%} "
        f"| {row['success_rate']:.0%} | {row['converged_rate']:.0%} "
        f"| {row['silent_failure_rate']:.0%} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"
