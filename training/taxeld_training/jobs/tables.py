"""Rows of samplers compared with each other, and as a table in Markdown: means over the objects,
with their intervals over readings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_training.jobs.rows import DISTANCES, EXACT, Row, label
from taxeld_training.jobs.statistics import of_mean, p_paired

# heading: how a mean of rows is written
COLUMNS = {
    "objects": lambda rows: str(len(rows)),
    "energy distance": lambda rows: f"{_mean(rows, 'energy_distance'):.4f}{_interval(rows)}",
    "× floor": lambda rows: f"{_mean(rows, 'energy_distance') / _mean(rows, 'energy_floor'):.2f}",
    "in 90 % region": lambda rows: f"{_mean(rows, 'coverage_90'):.0%}",
    "MFLOP": lambda rows: f"{_mean(rows, 'flops') / 1e6:.1f}" if rows[0]["flops"] else "",
    "ms": lambda rows: f"{_mean(rows, 'ms'):.2f}",
    "ms warm": lambda rows: f"{_mean(rows, 'ms_warm'):.2f}",
    "speed-up": lambda rows: f"{_mean(rows, 'speedup'):.0f} ×",
    "speed-up warm": lambda rows: f"{_mean(rows, 'speedup_warm'):.0f} ×",
    "ADD, mm": lambda rows: f"{np.mean([row['add_mm']['median'] for row in rows]):.1f}",
    "symmetric ADD, mm": lambda rows: f"{_mean(rows, 'add_sym_mm'):.1f}",
    "contact residual, mm": lambda rows: f"{_mean(rows, 'contact_residual_mm'):.2f}",
    "observation residual": lambda rows: f"{_mean(rows, 'observation_residual'):.3f}",
}
SOURCE = {
    "energy distance": "energy_distance", "× floor": "energy_floor",
    "in 90 % region": "coverage_90", "MFLOP": "flops", "ms": "ms", "ms warm": "ms_warm",
    "speed-up": "speedup", "speed-up warm": "speedup_warm",
    "ADD, mm": "add_mm", "symmetric ADD, mm": "add_sym_mm",
    "contact residual, mm": "contact_residual_mm", "observation residual": "observation_residual",
}  # fmt: skip


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


def write(rows: Sequence[Row], data: Path) -> None:
    """The table beside the rows' own file."""
    data.with_suffix(".md").write_text(means(rows) + "\n", encoding="utf-8")


def means(rows: Sequence[Row]) -> str:
    """A table a number of taxel columns, samplers nearest the exact posterior first."""
    return "\n\n".join(
        f"{columns or 'other'} columns:\n\n{_table([r for r in rows if r['columns'] == columns])}"
        for columns in sorted({row["columns"] for row in rows})
    )


def _table(rows: Sequence[Row]) -> str:
    of: dict[str, list[Row]] = {}
    for row in rows:
        of.setdefault(label(row), []).append(row)
    nearest = min(of.keys() - {EXACT}, key=lambda name: _mean(of[name], "energy_distance"))
    shown = [h for h in COLUMNS if SOURCE.get(h, "object") in rows[0]]
    order = sorted(of, key=lambda name: _mean(of[name], "energy_distance"))
    lines = [["sampler", *shown, "p"], ["---"] * (len(shown) + 2)]
    lines += [
        [name, *(COLUMNS[heading](of[name]) for heading in shown), _p(of[name], of[nearest])]
        for name in order
    ]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


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


def _mean(rows: Sequence[Row], key: str) -> float:
    """nan where a row has none."""
    return float(np.mean([np.nan if row[key] is None else row[key] for row in rows]))
