"""Rows of experiments as tables in Markdown, and samplers compared with the nearest one."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_training.jobs.rows import (
    DISTANCES,
    EXACT,
    Row,
    condition,
    label,
    method,
    object_name,
    spread_of,
)
from taxeld_training.jobs.statistics import of_count, of_mean, p_paired

FIGURES = {  # heading: key of a row, and how its mean over objects is written
    "in 90 % region": ("coverage_90", "{:.0%}"),
    "operations": ("flops", "{:.2g}"),
    "ms": ("ms", "{:.2f}"),
    "ms warm": ("ms_warm", "{:.2f}"),
    "speed-up": ("speedup", "{:.0f} ×"),
    "speed-up warm": ("speedup_warm", "{:.0f} ×"),
    "ADD, mm": ("add_mm", "{:.1f}"),
    "symmetric ADD, mm": ("add_sym_mm", "{:.1f}"),
    "contact residual, mm": ("contact_residual_mm", "{:.2f}"),
    "observation residual": ("observation_residual", "{:.3f}"),
}
SHARES = {  # heading: key of a row of trials
    "success": "success_rate",
    "flagged": "flagged_rate",
    "silent at the end": "silent_failure_rate",
    "silent at any contact": "silent_so_far_rate",
}


def save(text: str, data: Path) -> None:
    """A table beside its rows' own file."""
    data.with_suffix(".md").write_text(text + "\n", encoding="utf-8")


def compared(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with `p_nearest`: how likely chance alone parts a sampler so far from the nearest one,
    the exact posterior left out, on the same object, skin and readings."""
    nearest: dict[tuple[str, int], dict[str, Any]] = {}
    for row in sorted(rows, key=lambda row: -float(row["energy_distance"])):
        if row["proposal"] != EXACT:
            nearest[row["object"], row["columns"]] = row
    best = [nearest.get((row["object"], row["columns"])) for row in rows]
    return [
        row | {"p_nearest": to and p_paired(row[DISTANCES], to[DISTANCES])}
        for row, to in zip(rows, best, strict=True)
    ]


def samplers(rows: Sequence[Row]) -> str:
    """Means over objects, with intervals over readings: a table a number of taxel columns, samplers
    nearest the exact posterior first."""
    parts = []
    for columns in sorted({row["columns"] for row in rows}):
        of = _grouped([row for row in rows if row["columns"] == columns], label)
        order = sorted(of, key=lambda name: _mean(of[name], "energy_distance"))
        nearest = next(name for name in order if name != EXACT)
        shown = {h: f for h, f in FIGURES.items() if f[0] in rows[0]}
        lines = [
            [
                name,
                str(len(of[name])),
                f"{_mean(of[name], 'energy_distance'):.4f}{_interval(of[name])}",
                f"{_mean(of[name], 'energy_distance') / _mean(of[name], 'energy_floor'):.2f}",
                *(_written(form, _mean(of[name], key)) for key, form in shown.values()),
                _p(of[name], of[nearest]),
            ]
            for name in order
        ]
        heads = ["sampler", "objects", "energy distance", "× floor", *shown, "p"]
        parts.append(f"{columns or 'other'} columns:\n\n{_piped(heads, lines)}")
    return "\n\n".join(parts)


def trials(rows: Sequence[Row]) -> str:
    """Filters in trials: each method over all conditions, and then under each, contact by contact:
    success with its interval, and the median error."""
    heads = ["method", "object", "cells", *SHARES]
    last = max(row["contact"] for row in rows)
    lines = []
    for name, of in _grouped([row for row in rows if row["contact"] == last], method).items():
        for thing, mine in {"all": of, **_grouped(of, _object)}.items():
            pooled = [_pooled(mine, key) for key in SHARES.values()]
            lines.append([name, thing, str(len(mine)), *pooled])
    parts = [_piped(heads, lines)]
    contacts = sorted({row["contact"] for row in rows})
    lines = []
    for name, of in _grouped(rows, lambda row: (_object(row), condition(row), method(row))).items():
        at = {row["contact"]: _success(row) for row in of}
        lines.append([*name, *(at.get(contact, "") for contact in contacts)])
    heads = ["object", "condition", "method", *(f"after {contact}" for contact in contacts)]
    return "\n\n".join([*parts, _piped(heads, lines)])


def distances(rows: Sequence[Row]) -> str:
    """Samplers on touches of trials: a line an object and condition, a column a proposal; mean
    distance to the exact posterior, and its median in brackets."""
    names = list(dict.fromkeys(row["proposal"] for row in rows))
    lines = []
    for (name, given), of in _grouped(rows, lambda row: (_object(row), condition(row))).items():
        at = {r["proposal"]: f"{r['energy_distance']:.3f} ({r['median']:.3f})" for r in of}
        lines.append([name, given, *(at.get(proposal, "") for proposal in names)])
    return _piped(["object", "condition", *names], lines)


def _piped(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    every = [heads, ["---"] * len(heads), *lines]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in every)


def _grouped(rows: Sequence[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    found: dict[Any, list[Row]] = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    return found


def _object(row: Row) -> str:
    return object_name(str(row["object"]))


def _mean(rows: Sequence[Row], key: str) -> float:
    """nan where a row has none."""
    return float(np.mean([spread_of(row.get(key))[0] for row in rows]))


def _written(form: str, value: float) -> str:
    return form.format(value) if np.isfinite(value) else ""


def _interval(rows: Sequence[Row]) -> str:
    """Of a mean over objects of means over readings."""
    if not all(DISTANCES in row for row in rows):
        return ""
    low, high = of_mean([row[DISTANCES] for row in rows], np.random.default_rng(0))
    return f" ({low:.4f} – {high:.4f})"


def _p(rows: Sequence[Row], nearest: Sequence[Row]) -> str:
    """That a sampler is as near as the nearest, over the readings that both have."""
    theirs = {row["object"]: row for row in nearest}
    both = [(row, theirs[row["object"]]) for row in rows if row["object"] in theirs]
    if rows[0] is nearest[0] or not all(DISTANCES in row for pair in both for row in pair):
        return ""
    mine, best = (np.concatenate([pair[i][DISTANCES] for pair in both]) for i in (0, 1))
    return f"{p_paired(mine, best):.2g}"


def _pooled(rows: Sequence[Row], key: str) -> str:
    """A share of all the rows' trials, with its interval."""
    if any(row[key] is None for row in rows):
        return ""
    total = sum(int(row["seeds"]) for row in rows)
    count = round(sum(float(row[key]) * int(row["seeds"]) for row in rows))
    low, high = of_count(count, total)
    return f"{count / total:.1%} ({low:.1%} – {high:.1%})"


def _success(row: Row) -> str:
    low, high = row["success_ci"]
    text = f"{row['success_rate']:.0%} ({100 * low:.0f} – {100 * high:.0f})"
    error = row["map_mm"]["median"]
    return text if error is None else f"{text}, {error:.2g} mm"
