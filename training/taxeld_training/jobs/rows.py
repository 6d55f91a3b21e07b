"""Rows of experiments, as pictures and tables read them: a row is one sampler on one object and
skin. What a row lacks, or has as null, reads as nan and leaves a gap in a picture."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

GRID = "grid"  # `proposal` of the grid filter's rows
EXACT = "exact"  # `proposal` of the exact posterior's rows
DISTANCES = "distances"  # distances of each reading, for intervals and paired tests
SUCCESS_MM = 10.0  # symmetric ADD of the heaviest mode under which a trial has succeeded

Row = Mapping[str, Any]
Point = tuple[float, float]  # time of a call [ms], distance to the exact posterior [of the floor]
Spread = tuple[float, float, float]  # median, best, worst


def number(value: Any) -> float:
    return math.nan if value is None else float(value)


def spread_of(value: Any) -> Spread:
    """A measure of a row: a number, or a map of its median, best and worst."""
    if isinstance(value, Mapping):
        return number(value["median"]), number(value["best"]), number(value["worst"])
    return number(value), math.nan, math.nan


def gap(row: Row) -> Spread:
    """Distance to the exact posterior as a multiple of the floor, that of two exact sets."""
    floor = number(row.get("energy_floor"))
    if not floor > 0.0:
        return math.nan, math.nan, math.nan
    median, best, worst = spread_of(row.get("energy_distance"))
    return median / floor, best / floor, worst / floor


def label(row: Row) -> str:
    """The sampler with its steps × width, if it has them."""
    numbers = [str(row[key]) for key in ("steps", "width") if row.get(key)]
    return " ".join([str(row["proposal"]), " × ".join(numbers)]).strip()


def object_name(name: str) -> str:
    """003_cracker_box → cracker box."""
    return re.sub(r"^\d+(-\w)?_", "", name).replace("_", " ")


def method(row: Row) -> str:
    """A filter's method: its proposal, its rule of injection, and its particles if they adapt."""
    words = [str(row["proposal"]), str(row["injection"])]
    if row.get("particles_max", 0) > row.get("particles", 0):
        words.append(f"{row['particles']}..{row['particles_max']}")
    return " ".join(word for word in words if word)


def condition(row: Row) -> str:
    """What differs in a row's trials from what a filter assumes: factor and level."""
    factor, level = row.get("factor", "as assumed"), row.get("level")
    if factor == "as assumed":
        return str(factor)
    return f"{factor}: {object_name(level) if isinstance(level, str) else format(level, 'g')}"


def costs(rows: Sequence[Row], columns: int) -> dict[str, dict[str, Point]]:
    """object: label: point, of the complete rows of `columns` columns."""
    found: dict[str, dict[str, Point]] = {}
    for row in rows:
        point = (number(row.get("ms")), gap(row)[0])
        if row["columns"] == columns and all(math.isfinite(v) and v > 0.0 for v in point):
            found.setdefault(str(row["object"]), {})[label(row)] = point
    return found


def means(found: Mapping[str, Mapping[str, Point]]) -> tuple[dict[str, Point], set[str]]:
    """Each label's mean over its objects; the labels that some object lacks."""
    of: dict[str, list[Point]] = {}
    for points in found.values():
        for name, point in points.items():
            of.setdefault(name, []).append(point)
    mean = {name: np.mean(points, axis=0) for name, points in of.items()}
    partial = {name for name, points in of.items() if len(points) < len(found)}
    return {name: (float(x), float(y)) for name, (x, y) in mean.items()}, partial


def mean_of(rows: Sequence[Row], columns: int, key: str) -> float:
    """Over the rows of `columns` columns that have it; nan if none has."""
    values = [number(row.get(key)) for row in rows if row["columns"] == columns]
    finite = [value for value in values if math.isfinite(value)]
    return float(np.mean(finite)) if finite else math.nan
