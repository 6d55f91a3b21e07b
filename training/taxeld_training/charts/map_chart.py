"""The map of where filters fail."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from taxeld_training.charts import picture
from taxeld_training.jobs.rows import Row, condition, number, object_name

WRONG, SYMMETRIC = "wrong object", "symmetric"
MISLEADING_MAX = 0.01  # a cell of the map with a larger share that misleads is framed
CELL_IN = (0.62, 0.2)
NOTE = (
    "cells: % of trials found after 8 touches (colour), and after a stroke % misleading,\n"
    f"framed above {MISLEADING_MAX:.0%}; a wrong object cannot be found: coloured by the trials\n"
    "that are not sure"
)


def draw(rows: Sequence[Row], path: Path) -> None:
    """The map: a panel for each object, a line a condition, a column a method; symmetric objects
    below."""
    main = [row for row in rows if row["factor"] != SYMMETRIC] or rows
    other = [row for row in rows if row["factor"] == SYMMETRIC and row not in main]
    objects = list(dict.fromkeys(row["object"] for row in main))
    methods = list(dict.fromkeys((row["proposal"], row["injection"]) for row in rows))
    lines, below = (list(dict.fromkeys(map(condition, part))) for part in (main, other))
    width = 1.9 + (CELL_IN[0] * len(methods) + 0.2) * len(objects)
    height = 1.3 + CELL_IN[1] * (len(lines) + len(below)) + (0.4 if below else 0.0)
    figure = Figure(figsize=(max(width, 5.5), height), layout="constrained")
    heights = [len(lines), len(below)] if below else [len(lines)]
    panels = figure.subplots(len(heights), len(objects), height_ratios=heights, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, name in zip(panels[0], objects, strict=True):
        mine = [row for row in main if row["object"] == name]
        _panel(axes, mine, lines, methods)
        if axes is not panels[0, 0]:
            axes.set_yticks([])
        axes.set_title(object_name(name), fontsize=9, pad=26)
    if below:
        _panel(panels[1, 0], other, below, methods)
        panels[1, 0].set_xticks([])
        panels[1, 0].set_title("symmetric objects", fontsize=9, pad=3, loc="left")
    figure.supxlabel(NOTE, fontsize=7, x=0.01, ha="left")
    picture.save(figure, path, palette=True)


def _percent(share: float) -> str:
    return "" if np.isnan(share) else f"{100 * share:.0f}"


def _panel(
    axes: Axes, rows: Sequence[Row], lines: Sequence[str], methods: Sequence[tuple[str, str]]
) -> None:
    """A cell for each row, coloured by the share found."""
    axes.set_axis_on()
    axes.set(xlim=(0, len(methods)), ylim=(len(lines), 0))
    heads = [f"{proposal}\n{injection}" for proposal, injection in methods]
    axes.set_xticks([i + 0.5 for i in range(len(methods))], heads, fontsize=7)
    axes.set_yticks([i + 0.5 for i in range(len(lines))], lines, fontsize=7)
    axes.tick_params(length=0, top=False, bottom=False, labeltop=True, labelbottom=False)
    axes.spines[:].set_visible(False)

    for row in rows:
        x = methods.index((row["proposal"], row["injection"]))
        y = lines.index(condition(row))
        wrong, misled = row["factor"] == WRONG, number(row.get("misleading_rate"))
        good = 1.0 - number(row.get("sure_rate")) if wrong else row["found_rate"]
        bad = misled > MISLEADING_MAX
        fill = mpl.colormaps["RdYlBu"](good)  # for colour-blind readers too
        axes.add_patch(Rectangle((x, y), 1.0, 1.0, fc=fill, ec="white", lw=0.8))
        if bad:
            frame = Rectangle((x + 0.03, y + 0.06), 0.94, 0.88, fc="none", ec="black", lw=1.2)
            axes.add_patch(frame)
        axes.text(
            x + 0.5,
            y + 0.52,
            f"{'–' if wrong else _percent(good)} / {_percent(misled)}",
            ha="center",
            va="center",
            fontsize=7,
            weight="bold" if bad else "normal",
            color="white" if good < 0.12 or good > 0.88 else "black",
        )
