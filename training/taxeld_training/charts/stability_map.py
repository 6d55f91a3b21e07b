"""The map of where methods fail, and its table, from the stability experiment's rows."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from taxeld_training.charts import picture
from taxeld_training.jobs.rows import Row, object_name
from taxeld_training.jobs.statistics import of_count

WRONG = "wrong object"
SYMMETRIC = "symmetric"
TWO = "two objects"
COLOURS = "RdYlBu"  # from failure to success, for colour-blind readers too
SILENT_MAX = 0.01  # a cell with a larger share of silent failures is framed
LABELS = {
    "noise": "noise sd {}", "gain spread": "gain spread {}", "dead share": "{:.0%} of taxels dead",
    "dead modules": "{} of 8 modules dead", "stuck at 1": "taxels stuck at 1: {}",
    "stuck at 0": "taxels stuck at 0: {}", "drift": "baselines drift to ±{}",
    "skin": "a {} soft skin", "columns": "{} columns", "depth": "pressed {} δ_max deep",
    "sensor mm": "sensor pose ±{:g} mm", "sensor deg": "sensor pose ±{:g}°",
    "two objects": "touches of two objects: {}",
    "particles": "{} particles", "one side": "touched within {}", "scans": "{} scans × taxels",
}  # fmt: skip
LOST = 0.5  # where no method reaches this success, all are said to fail
CELL_IN = (0.62, 0.2)


def label_of(row: Row) -> str:
    """A level in words."""
    factor, level = str(row["factor"]), row["level"]
    if factor in LABELS:
        return LABELS[factor].format(level)
    if factor == WRONG:
        return f"is a {object_name(level)}"
    if factor == SYMMETRIC:
        return object_name(level)
    if factor == "moved":
        return (
            "put elsewhere after 4 touches"
            if isinstance(level, str)
            else f"moved {level:g} mm a touch"
        )
    return factor


def draw(rows: Sequence[Row], path: Path) -> None:
    """A panel for each object, a line a level, a column a method; symmetric objects below."""
    main = [row for row in rows if row["factor"] != SYMMETRIC] or rows
    other = [row for row in rows if row["factor"] == SYMMETRIC and row not in main]
    objects = list(dict.fromkeys(row["object"] for row in main))
    methods = list(dict.fromkeys((row["proposal"], row["injection"]) for row in rows))
    lines = list(dict.fromkeys(label_of(row) for row in main))
    below = list(dict.fromkeys(label_of(row) for row in other))
    width = 1.9 + (CELL_IN[0] * len(methods) + 0.2) * len(objects)
    height = 1.3 + CELL_IN[1] * (len(lines) + len(below)) + (0.4 if below else 0.0)
    figure = Figure(figsize=(max(width, 5.5), height), layout="constrained")
    heights = [len(lines), len(below)] if below else [len(lines)]
    panels = figure.subplots(len(heights), len(objects), height_ratios=heights, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, name in zip(panels[0], objects, strict=True):
        mine = [row for row in main if row["object"] == name]
        _panel(axes, mine, lines, methods, named=axes is panels[0, 0])
        axes.set_title(object_name(name), fontsize=9, pad=26)
    if below:
        _panel(panels[1, 0], other, below, methods, named=True, headed=False)
        panels[1, 0].set_title("symmetric objects", fontsize=9, pad=3, loc="left")
    figure.supxlabel(
        "cells: % of trials under 10 mm after 8 touches (colour), and after a stroke\n"
        f"% converged while over 20 mm off, framed above {SILENT_MAX:.0%}; for a wrong object\n"
        "there is no success: coloured by the trials that were flagged",
        fontsize=7, x=0.01, ha="left",
    )  # fmt: skip
    picture.save(figure, path, palette=True)


def _panel(
    axes: Axes, rows: Sequence[Row], lines: Sequence[str], methods: Sequence[tuple[str, str]], *,
    named: bool, headed: bool = True,
) -> None:  # fmt: skip
    axes.set_axis_on()
    colours = mpl.colormaps[COLOURS]
    for row in rows:
        x = methods.index((row["proposal"], row["injection"]))
        y = lines.index(label_of(row))
        good = _good(row)
        axes.add_patch(Rectangle((x, y), 1.0, 1.0, fc=colours(good), ec="white", lw=0.8))
        silent = row["silent_failure_rate"]
        bad = silent > SILENT_MAX
        if bad:
            axes.add_patch(
                Rectangle((x + 0.03, y + 0.06), 0.94, 0.88, fc="none", ec="black", lw=1.2)
            )
        text = f"{'–' if row['factor'] == WRONG else f'{100 * good:.0f}'} / {100 * silent:.0f}"
        dark = good < 0.12 or good > 0.88
        axes.text(
            x + 0.5, y + 0.52, text, ha="center", va="center", fontsize=7,
            color="white" if dark else "black", weight="bold" if bad else "normal",
        )  # fmt: skip
    axes.set(xlim=(0, len(methods)), ylim=(len(lines), 0))
    heads = [f"{proposal}\n{injection}" for proposal, injection in methods]
    axes.set_xticks([i + 0.5 for i in range(len(methods))], heads if headed else [], fontsize=7)
    axes.set_yticks([i + 0.5 for i in range(len(lines))], lines if named else [], fontsize=7)
    axes.tick_params(length=0, top=False, bottom=False, labeltop=True, labelbottom=False)
    axes.spines[:].set_visible(False)


def table(rows: Sequence[Row], path: Path) -> None:
    """Each method over the whole map, and the cells where every method fails, in Markdown."""
    methods = list(dict.fromkeys((row["proposal"], row["injection"]) for row in rows))
    objects = list(dict.fromkeys(row["object"] for row in rows))
    heads = [
        "method", "object", "cells", "success", "flagged", "silent failures",
        "silent at any contact", "worst cell",
    ]  # fmt: skip
    lines = [heads, ["---"] * len(heads)]
    for proposal, injection in methods:
        mine = [r for r in rows if (r["proposal"], r["injection"]) == (proposal, injection)]
        lines += [
            _line(
                f"{proposal} {injection}", name, [r for r in mine if name in ("all", r["object"])]
            )
            for name in ("all", *objects)
            if name == "all" or any(r["object"] == name for r in mine)
        ]
    parts = ["\n".join("| " + " | ".join(line) + " |" for line in lines)]
    parts.append("Two objects of a kind: either is found / the one that the trial means.")
    parts.append("\n".join(
        f"- {object_name(row['object'])}, {label_of(row)}, {row['proposal']} {row['injection']}: "
        f"{row['success_rate']:.0%} / {row['success_meant_rate']:.0%}"
        for row in rows if row["factor"] == TWO
    ) or "none")  # fmt: skip
    by_cell: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        by_cell.setdefault((object_name(row["object"]), label_of(row)), []).append(row)
    lost = [
        f"- {name}, {label}: at best {max(map(_good, mine)):.0%}"
        for (name, label), mine in by_cell.items()
        if max(map(_good, mine)) < LOST
    ]
    parts.append("\n".join([f"Cells where no method reaches {LOST:.0%}:", "", *(lost or ["none"])]))
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _line(method: str, name: str, rows: Sequence[Row]) -> list[str]:
    worst = max(rows, key=lambda row: float(row["silent_failure_rate"]))
    return [
        method, object_name(name), str(len(rows)),
        *(_pooled(rows, key) for key in ("success_rate", "flagged_rate", "silent_failure_rate",
                                         "silent_so_far_rate")),
        f"{object_name(worst['object'])}, {label_of(worst)}: {worst['silent_failure_rate']:.0%}",
    ]  # fmt: skip


def _pooled(rows: Sequence[Row], key: str) -> str:
    """A share of all the rows' trials, with its interval."""
    trials = sum(int(row["seeds"]) for row in rows)
    count = round(sum(float(row[key]) * int(row["seeds"]) for row in rows))
    low, high = of_count(count, trials)
    return f"{count / trials:.1%} ({low:.1%} – {high:.1%})"


def _good(row: Row) -> float:
    """The share that did what it should: succeed, or flag a wrong object."""
    return float(row["flagged_rate"] if row["factor"] == WRONG else row["success_rate"])
