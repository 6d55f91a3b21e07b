"""Pictures from the rows of experiments; matplotlib is imported here alone.

A row is one filter on one object and skin: `failures` is the map of where filters fail, `front`
says what a touch costs against how often the object is found for sure, `reliability` whether p
keeps its word. The same rows give the same bytes.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from PIL import Image

Row = Mapping[str, Any]
Style = tuple[str, str]  # colour, marker

# Okabe and Ito's colours, for colour-blind readers; grey replaces their yellow, which is too pale
COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#E69F00",
    "#888888",
    "#CC79A7",
    "#000000",
    "#56B4E9",
)
MARKERS = (
    "o",
    "s",
    "^",
    "D",
    "v",
    "P",
    ">",
)  # seven and eight colours: 56 pairs before one repeats
FIRST = (  # names with the same style in every picture
    "density",
    "paper",
    "table",
    "manifold",
    "projection",
)
DPI = 120

WRONG, SYMMETRIC = "wrong object", "symmetric"
MISLEADING_MAX = 0.01  # a cell of the map with a larger share that misleads is framed
CELL_IN = (0.62, 0.2)
NOTE = (
    "cells: % of trials found after 8 touches (colour), and after a stroke % misleading,\n"
    f"framed above {MISLEADING_MAX:.0%}; a wrong object cannot be found: coloured by the trials\n"
    "that are not sure"
)

ACROSS = 5  # panels side by side
AFTER = 6  # touches
GIVEN: dict[str, Any] = {"ls": "none", "mfc": "none", "mec": "black"}
MARKS = {  # keys of rows → marker, size and name in the legend
    "ships": ("s", 10.0, "as it ships"),
    "enough": ("*", 13.0, "the cheapest shown to be as good as the best"),
}


def styles(names: Iterable[str]) -> dict[str, Style]:
    """A colour and a marker for each name, in the order of a legend."""
    wanted = set(names)
    order = [*FIRST, *sorted(wanted - set(FIRST))]
    pairs = ((COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]) for i in range(len(order)))
    return {name: pair for name, pair in zip(order, pairs, strict=True) if name in wanted}


def _plain(axes: Axes, size: float) -> None:
    """No box, a faint grid, tick labels of `size` points."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=size)
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)


def _save(figure: Figure, path: Path) -> None:
    """Write a picture with a palette of 256 colours, as many faint lines would compress badly."""
    written = BytesIO()
    figure.savefig(written, dpi=DPI, format="png", metadata={"Software": None})
    # Quantised by coverage, rare colours stay.
    image = Image.open(written).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
    image.save(path, format="png", optimize=True)


def object_name(name: str) -> str:
    """003_cracker_box → cracker box."""
    return re.sub(r"^\d+(-\w)?_", "", name).replace("_", " ")


def _condition(row: Row) -> str:
    """The factor and level in which a row's trials differ from a filter's assumptions."""
    factor, level = row["factor"], row["level"]
    if factor == "as assumed":
        return str(factor)
    return f"{factor}: {object_name(level) if isinstance(level, str) else format(level, 'g')}"


def failures(rows: Sequence[Row], path: Path) -> None:
    """The map: a panel for each object, a line a condition, a column a method; symmetric objects
    below."""
    main = [row for row in rows if row["factor"] != SYMMETRIC] or rows
    other = [row for row in rows if row["factor"] == SYMMETRIC and row not in main]
    objects = list(dict.fromkeys(row["object"] for row in main))
    methods = list(dict.fromkeys((row["proposal"], row["injection"]) for row in rows))
    lines, below = (list(dict.fromkeys(map(_condition, part))) for part in (main, other))
    width = 1.9 + (CELL_IN[0] * len(methods) + 0.2) * len(objects)
    height = 1.3 + CELL_IN[1] * (len(lines) + len(below)) + (0.4 if below else 0.0)
    figure = Figure(figsize=(max(width, 5.5), height), layout="constrained")
    heights = [len(lines), len(below)] if below else [len(lines)]
    panels = figure.subplots(len(heights), len(objects), height_ratios=heights, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, name in zip(panels[0], objects, strict=True):
        mine = [row for row in main if row["object"] == name]
        _map_panel(axes, mine, lines, methods)
        if axes is not panels[0, 0]:
            axes.set_yticks([])
        axes.set_title(object_name(name), fontsize=9, pad=26)
    if below:
        _map_panel(panels[1, 0], other, below, methods)
        panels[1, 0].set_xticks([])
        panels[1, 0].set_title("symmetric objects", fontsize=9, pad=3, loc="left")
    figure.supxlabel(NOTE, fontsize=7, x=0.01, ha="left")
    _save(figure, path)


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.0f}"


def _map_panel(
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
        y = lines.index(_condition(row))
        wrong, misled = row["factor"] == WRONG, row["misleading_rate"]
        good = row["found_rate"]
        if wrong:
            good = math.nan if row["sure_rate"] is None else 1.0 - row["sure_rate"]
        bad = misled is not None and misled > MISLEADING_MAX
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


def front(rows: Sequence[Row], path: Path) -> None:
    """A panel for each object and condition, with the front of its filters. Those by the paper's
    rule are hollow."""
    style = styles(row["proposal"] for row in rows)
    scenes = list(dict.fromkeys(map(_scene, rows)))
    across = min(ACROSS, len(scenes))
    down = -(-len(scenes) // across)
    size = max(2.1 * across, 6.0), 1.9 * down + 1.0
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
    for axes in panels.flat[len(scenes) :]:
        axes.set_axis_off()
    for k, (scene, axes) in enumerate(zip(scenes, panels.flat, strict=False)):
        _front_panel(axes, [row for row in rows if _scene(row) == scene], style)
        axes.set_title("\n".join(scene), fontsize=8, pad=3)
        axes.tick_params(labelbottom=k + across >= len(scenes))
    figure.supxlabel("processor time of a touch [ms]", fontsize=9)
    figure.supylabel(f"found and sure after {AFTER} touches", fontsize=9)
    handles = [
        *(
            Line2D([], [], color=c, marker=m, ls="none", ms=5, label=n)
            for n, (c, m) in style.items()
        ),
        *(Line2D([], [], marker=m, ms=8, label=n, **GIVEN) for m, _, n in MARKS.values()),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, fontsize=8, frameon=False)
    _save(figure, path)


def _scene(row: Row) -> tuple[str, str]:
    return object_name(str(row["object"])), _condition(row)


def _share(row: Row) -> float:
    return float(row["found_and_sure"][AFTER - 1] / row["trials"])


def _front_panel(axes: Axes, rows: Sequence[Row], style: dict[str, Style]) -> None:
    _plain(axes, 7)
    axes.set(xscale="log", ylim=(-0.03, 1.05))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    for row in rows:
        colour, marker = style[row["proposal"]]
        fill = "white" if row["injection"] == "paper" else colour
        given: dict[str, Any] = {"ms": 4.0, "mec": colour, "mfc": fill, "mew": 0.8, "alpha": 0.85}
        axes.plot(row["ms"], _share(row), marker, **given)
        for key, (mark, size, _) in MARKS.items():
            if row[key]:
                axes.plot(row["ms"], _share(row), mark, ms=size, zorder=4, **GIVEN)
    best = sorted((row["ms"], _share(row)) for row in rows if row["on_front"])
    if best:
        x, y = zip(*best, strict=True)
        last = max(row["ms"] for row in rows)
        axes.step([*x, last], [*y, y[-1]], where="post", color="0.5", lw=0.9, zorder=1)


def reliability(over: Sequence[Row], path: Path) -> None:
    """The share that is found over the mean p of each bin, a curve for each row."""
    figure = Figure(figsize=(5.0, 4.2), layout="constrained")
    axes = figure.subplots()
    _plain(axes, 8)
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", lw=0.8, ls=":")
    for row, colour, marker in zip(over, COLOURS, MARKERS, strict=False):
        x, y = ([each[key] for each in row["reliability"]] for key in ("mean_p", "right"))
        label = f"{row['over']} ({row['estimates']})"
        axes.plot(x, y, label=label, color=colour, marker=marker, ms=4)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.set_xlabel("p", fontsize=9)
    axes.set_title("share of estimates that are found", fontsize=9)
    axes.legend(fontsize=7, frameon=False)
    _save(figure, path)
