"""Rows of experiments: how pictures read them, and their tables in Markdown.

A row is one sampler, or one filter, on one object and skin. What a row lacks, or has as null, reads
as nan and leaves a gap.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from taxeld_training.jobs.statistics import of_mean, p_paired

GRID = "grid"  # `proposal` of the grid filter's rows
EXACT = "exact"  # `proposal` of the exact posterior's rows
ALL = "all"  # object of a line over all objects
DISTANCES = "distances"  # distances of each reading, for intervals and paired tests

Row = Mapping[str, Any]
Cell = Callable[[list[Row]], str]  # rows of a table's line → the text of a cell

FIGURES = {  # heading → key of a sampler's row, and the format of its mean over objects
    "ADD, mm": ("add_mm", "{:.1f}"),
    "in 90 % region": ("coverage_90", "{:.0%}"),
    "operations": ("flops", "{:.2g}"),
}
SHARES = {  # heading → key of a row of trials
    "found": "found_rate",
    "sure": "sure_rate",
    "misleading at the end": "misleading_rate",
    "misleading at any contact": "misleading_so_far_rate",
}


def number(value: Any) -> float:
    return math.nan if value is None else float(value)


def median_of(value: Any) -> float:
    """A measure of a row: a number, or the median of a map of quantiles."""
    return number(value["median"] if isinstance(value, Mapping) else value)


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
    """The factor and level in which a row's trials differ from a filter's assumptions."""
    factor, level = row.get("factor", "as assumed"), row.get("level")
    if factor == "as assumed":
        return str(factor)
    return f"{factor}: {object_name(level) if isinstance(level, str) else format(level, 'g')}"


def mean_of(rows: Sequence[Row], key: str) -> float:
    """Mean of a measure; nan where a row has none."""
    return float(np.mean([median_of(row.get(key)) for row in rows]))


def table(
    rows: Sequence[Row], heads: Mapping[str, Callable[[Row], str]], cells: Mapping[str, Cell]
) -> str:
    """A line for each group of rows that agree in all `heads`, by heading, then its `cells`."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(head(row) for head in heads.values()), []).append(row)
    lines = [[*heads, *cells], ["---"] * (len(heads) + len(cells))]
    lines += [[*group, *(cell(of) for cell in cells.values())] for group, of in groups.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number_of(key: str) -> Cell:
    """A cell with a figure of a line's only row; empty where it has none."""

    def text(rows: list[Row]) -> str:
        value = rows[0][key]
        return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)

    return text


def share_of(key: str, interval: str = "") -> Cell:
    """The same of a share, with its interval."""

    def text(rows: list[Row]) -> str:
        value: float | None = rows[0][key]
        if value is None:
            return ""
        if not interval:
            return f"{value:.1%}"
        low, high = rows[0][interval]
        return f"{value:.2%} ({100 * low:.2f} – {100 * high:.2f})"

    return text


def sampler_table(rows: Sequence[Row]) -> str:
    """Means over objects, with intervals over readings: a table for each number of taxel columns,
    samplers nearest the exact posterior first."""
    parts = []
    for columns in sorted({row["columns"] for row in rows}):
        mine = [row for row in rows if row["columns"] == columns]
        names = dict.fromkeys(map(label, mine))
        of = {name: [row for row in mine if label(row) == name] for name in names}
        order = sorted(of, key=lambda name: mean_of(of[name], "energy_distance"))
        nearest = of[next(name for name in order if name != EXACT)]
        cells: dict[str, Cell] = {
            "objects": lambda each: str(len(each)),
            "energy distance": _distance,
            "worst object": lambda each: f"{max(row['energy_distance'] for row in each):.4f}",
        }
        for heading, (key, form) in FIGURES.items():
            if key in mine[0]:
                cells[heading] = partial(_mean, key=key, form=form)
        cells["p"] = partial(_p, nearest=nearest)
        lines = table([row for name in order for row in of[name]], {"sampler": label}, cells)
        parts.append(f"{columns or 'other'} columns:\n\n{lines}")
    return "\n\n".join(parts)


def trial_table(rows: Sequence[Row]) -> str:
    """Filters in trials: each method over all conditions, and then under each, contact by contact:
    the share found with its interval, and the median error."""
    contacts = sorted({row["contact"] for row in rows})
    last = [row for row in rows if row["contact"] == contacts[-1]]
    shares: dict[str, Cell] = {"cells": lambda of: str(len(of))}
    shares |= {heading: partial(_pooled, key=key) for heading, key in SHARES.items()}
    shares["worst cell, found"] = partial(_worst, key="found_rate", pick=min)
    shares["misleading"] = partial(_worst, key="misleading_rate", pick=max)
    after = {f"after {contact}": partial(_found, contact=contact) for contact in contacts}
    both = [*({**row, ALL: True} for row in last), *last]
    heads = {"method": method, "object": lambda row: ALL if ALL in row else _object(row)}
    return "\n\n".join(
        [
            table(both, heads, shares),
            table(rows, {"object": _object, "condition": condition, "method": method}, after),
        ]
    )


def _object(row: Row) -> str:
    return object_name(str(row["object"]))


def _mean(rows: Sequence[Row], key: str, form: str) -> str:
    value = mean_of(rows, key)
    return form.format(value) if np.isfinite(value) else ""


def _distance(rows: Sequence[Row]) -> str:
    """Mean over objects of means over readings, with its interval."""
    text = _mean(rows, "energy_distance", "{:.4f}")
    if not all(DISTANCES in row for row in rows):
        return text
    low, high = of_mean([row[DISTANCES] for row in rows], np.random.default_rng(0))
    return f"{text} ({low:.4f} – {high:.4f})"


def _p(rows: Sequence[Row], nearest: Sequence[Row]) -> str:
    """How likely chance alone parts a sampler so far from the nearest one, over the readings that
    both have met."""
    theirs = {row["object"]: row for row in nearest}
    both = [(row, theirs[row["object"]]) for row in rows if row["object"] in theirs]
    if rows[0] is nearest[0] or not all(DISTANCES in row for pair in both for row in pair):
        return ""
    mine, best = (np.concatenate([pair[i][DISTANCES] for pair in both]) for i in (0, 1))
    return f"{p_paired(mine, best):.2g}"


def _pooled(rows: Sequence[Row], key: str) -> str:
    """A share of all the rows' trials. It has no interval: rows share seeds, so that their trials
    depend on each other."""
    if any(row[key] is None for row in rows):
        return ""
    total = sum(int(row["seeds"]) for row in rows)
    count = round(sum(float(row[key]) * int(row["seeds"]) for row in rows))
    return f"{count / total:.1%}"


def _worst(rows: Sequence[Row], key: str, pick: Callable[..., Row]) -> str:
    """The worst of all cells by a share; a wrong object cannot be found, and is left out there."""
    every = [row for row in rows if row.get(key) is not None]
    mine = [row for row in every if key != "found_rate" or row["map_mm"]["median"] is not None]
    if not mine:
        return ""
    row = pick(mine, key=lambda row: float(row[key]))
    return f"{row[key]:.0%}, {_object(row)}, {condition(row)}"


def _found(rows: Sequence[Row], contact: int) -> str:
    """The share found and the median error of the row of a contact."""
    mine = [row for row in rows if row["contact"] == contact]
    return ", ".join(_share(row) for row in mine)


def _share(row: Row) -> str:
    low, high = row["found_ci"]
    text = f"{row['found_rate']:.0%} ({100 * low:.0f} – {100 * high:.0f})"
    error = row["map_mm"]["median"]
    return text if error is None else f"{text}, {error:.2g} mm"
