"""The sampler experiments' pictures: cost against distance, and samplers side by side."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taxeld.errors import SetupError
from taxeld_training.charts import picture
from taxeld_training.charts.picture import Limits, Point, Style
from taxeld_training.jobs.rows import Row, Spread, gap, label, number, object_name, spread_of

ACROSS = 5  # small panels beside each other
PAPER_MS = 15.0
LEAST = 5e-4  # distance that is drawn: a nearer one cannot be told from none
GAP = "distance to exact posterior, over that of exact draws"
LINE: dict[str, Any] = {"color": "0.45", "lw": 0.9, "zorder": 1}


def pareto(points: Sequence[Point]) -> list[int]:
    """Indices of the points (cost, distance) that no other dominates, cheapest first.

    A point dominates another if it is worse in neither and better in one. Points that are not
    finite are left out.
    """
    finite = [i for i, point in enumerate(points) if all(map(math.isfinite, point))]
    front: list[int] = []
    for i in sorted(finite, key=points.__getitem__):
        last = points[front[-1]] if front else (math.inf, math.inf)
        if points[i][1] < last[1] or points[i] == last:
            front.append(i)
    return front


def frontier(rows: Sequence[Row], columns: int, path: Path) -> None:
    """Cost against distance to the exact posterior on skins of `columns` columns: the mean over all
    objects, of the samplers that were run on each of them.

    Raises:
        SetupError: no row of that many columns is complete.
    """
    found: dict[str, dict[str, Point]] = {}  # point by object and sampler
    for row in rows:
        point = (number(row.get("ms")), _shown(row)[0])
        if row["columns"] == columns and all(math.isfinite(v) for v in point):
            found.setdefault(str(row["object"]), {})[label(row)] = point
    if not found:
        raise SetupError(f"frontier: no complete row of {columns} columns")
    family = picture.styles(row["proposal"] for row in rows)
    style = {label(row): family[row["proposal"]] for row in rows}
    eager = [number(row.get("ms_eager_ddpm100")) for row in rows if row["columns"] == columns]
    eager_ms = float(np.mean(eager))
    names = [name for name in style if all(name in of for of in found.values())]
    mean = {name: _mean([of[name] for of in found.values()]) for name in names}
    limits = picture.limits([*mean.values(), *((ms, LEAST) for ms in (PAPER_MS, eager_ms))])
    figure = Figure(figsize=(10.0, 5.2), layout="constrained")
    axes = figure.add_subplot()
    front = _cloud(axes, mean, style, limits)
    _times(axes, eager_ms)
    what = f"mean of {len(found)} objects" if len(found) > 1 else object_name(next(iter(found)))
    title = f"{columns} columns, {what}\nlabels: steps × width"
    axes.set_title(title, loc="left", fontsize=9, pad=6)
    axes.set_xlabel("time of 100 samples on one thread [ms]", fontsize=9)
    axes.set_ylabel(GAP, fontsize=9)
    shown = {style[name] for name in mean}
    picture.legend(figure, {k: v for k, v in family.items() if v in shown}, "lower")
    for k, name in enumerate(front):  # alternately above and below, as neighbours are close
        up = 1 - 2 * (k % 2)
        axes.annotate(
            name,
            mean[name],
            (0, 8 * up),
            textcoords="offset points",
            fontsize=8,
            ha="center",
            va="bottom" if up > 0 else "top",
        )
    picture.save(figure, path)


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


def _mean(points: Sequence[Point]) -> Point:
    x, y = np.mean(points, axis=0).tolist()
    return x, y


def _cloud(
    axes: Axes, points: Mapping[str, Point], style: Mapping[str, Style], limits: Limits
) -> list[str]:
    """Draw the points and their front; → its labels."""
    for name, (x, y) in points.items():
        colour, marker = style[name]
        axes.plot(x, y, marker, ms=6.5, color=colour, zorder=3)
    front = [list(points)[i] for i in pareto(list(points.values()))]
    if front:
        xs, ys = zip(*[points[name] for name in front], strict=True)
        axes.step([*xs, limits[0][1]], [*ys, ys[-1]], where="post", color="0.35", lw=1.1, zorder=2)
    axes.loglog()
    axes.set(xlim=limits[0], ylim=limits[1])
    for axis in (axes.xaxis, axes.yaxis):
        picture.log_ticks(axis, (1.0, 2.0, 5.0))
    picture.plain(axes, 8)
    axes.axvline(PAPER_MS, ls=":", **LINE)
    return front


def _times(axes: Axes, eager_ms: float) -> None:
    """The paper's time and that of its sampler here, named above the axes."""
    notes = [(PAPER_MS, "Marić et al. 2025: 15 ms on 8 cores")]
    if math.isfinite(eager_ms):
        axes.axvline(eager_ms, ls=":", **LINE)
        notes.append((eager_ms, f"eager DDPM of 100 steps here: {eager_ms:.0f} ms"))
    for line, (x, text) in enumerate(sorted(notes)):
        axes.annotate(
            text,
            (x, 1.0),
            (0, 3 + 12 * line),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="right",
            va="bottom",
            fontsize=8,
        )


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
