"""Rows of an experiment as a table in Markdown: means over the objects."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from taxeld_training.jobs.rows import Row, label

# heading: how a mean of rows is written
COLUMNS = {
    "objects": lambda rows: str(len(rows)),
    "energy distance": lambda rows: f"{_mean(rows, 'energy_distance'):.4f}",
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
    shown = [h for h in COLUMNS if SOURCE.get(h, "object") in rows[0]]
    order = sorted(of, key=lambda name: _mean(of[name], "energy_distance"))
    lines = [["sampler", *shown], ["---"] * (len(shown) + 1)]
    lines += [[name, *(COLUMNS[heading](of[name]) for heading in shown)] for name in order]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def _mean(rows: Sequence[Row], key: str) -> float:
    """nan where a row has none."""
    return float(np.mean([np.nan if row[key] is None else row[key] for row in rows]))
