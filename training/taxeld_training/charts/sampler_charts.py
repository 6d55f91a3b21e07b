"""The sampler experiments' pictures: samplers side by side."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from taxeld_training.charts import picture
from taxeld_training.jobs.rows import Row, Spread, gap, object_name, spread_of

ACROSS = 5  # small panels beside each other
LEAST = 5e-4  # distance that is drawn: a nearer one cannot be told from none
GAP = "distance to exact posterior, over that of exact draws"


def proposals(rows: Sequence[Row], path: Path) -> None:
    """The error of each sampler's samples by object and columns: median, best and worst."""
    what = "ADD [mm]: median, best to worst"
    _dodged(rows, lambda row: spread_of(row.get("add_mm")), what, path)


def posterior_gap(rows: Sequence[Row], path: Path) -> None:
    """Each sampler's distance to the exact posterior by object and columns."""
    _dodged(rows, _shown, GAP, path, log=True)


def _shown(row: Row) -> Spread:
    median, best, worst = np.maximum(gap(row), LEAST).tolist()
    return median, best, worst


def _dodged(
    rows: Sequence[Row], value: Callable[[Row], Spread], what: str, path: Path, log: bool = False
) -> None:
    """Panels by object; in each, columns across and the samplers beside each other."""
    style = picture.styles(row["proposal"] for row in rows)
    objects = sorted({row["object"] for row in rows})
    columns = sorted({row["columns"] for row in rows})
    across = min(ACROSS, len(objects))
    down = -(-len(objects) // across)
    size = (10.0 if across > 2 else 6.0, 0.9 + (2.5 if across > 2 else 3.2) * down)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
    for axes in panels.flat[len(objects) :]:
        axes.set_axis_off()
    shift = dict(zip(style, np.linspace(-0.38, 0.38, len(style) + 2)[1:-1], strict=True))
    for i, (name, axes) in enumerate(zip(objects, panels.flat, strict=False)):
        axes.set_title(object_name(name), fontsize=9, pad=3)
        picture.plain(axes, 8)
        axes.grid(visible=False, axis="x")
        for at in range(0, len(columns), 2):
            axes.axvspan(at - 0.5, at + 0.5, color="0.96", lw=0, zorder=0)
        for row in (row for row in rows if row["object"] == name):
            colour, marker = style[row["proposal"]]
            x = columns.index(row["columns"]) + shift[row["proposal"]]
            median, best, worst = value(row)
            axes.plot([x, x], [best, worst], color=colour, lw=1.2, alpha=0.6)
            axes.plot(x, median, marker, color=colour, ms=4.0)
        axes.set_xticks(range(len(columns)), [str(n) for n in columns])
        axes.set_xlim(-0.5, len(columns) - 0.5)
        axes.tick_params(labelbottom=i + across >= len(objects))
        if log:
            axes.set_yscale("log")
            picture.log_ticks(axes.yaxis, (1.0, 2.0, 5.0))
    if not log:
        panels[0, 0].set_ylim(bottom=0.0)
    figure.supxlabel("columns of taxels", fontsize=9)
    figure.supylabel(what, fontsize=9)
    picture.legend(figure, style, "upper")
    picture.save(figure, path)
