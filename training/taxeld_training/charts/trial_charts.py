"""Pictures of filters in trials: errors by contact, and the map of where filters fail."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from taxeld_hil.integrity import FOUND_MM
from taxeld_training.charts import picture
from taxeld_training.jobs.rows import GRID, Row, condition, method, number, object_name

ACROSS = 5  # panels side by side
DASHES = {"mixture": "-", "paper": (0, (3, 1.5)), "": "-"}
SHOWN_MM = (0.05, 300.0)
# lines have no markers, so the grid takes the colour of a sampler that no filter is compared with
OWN = {GRID: picture.COLOURS[1]}
WRONG, SYMMETRIC = "wrong object", "symmetric"
MISLEADING_MAX = 0.01  # a cell of the map with a larger share that misleads is framed
CELL_IN = (0.62, 0.2)
NOTE = (
    "cells: % of trials found after 8 touches (colour), and after a stroke % misleading,\n"
    f"framed above {MISLEADING_MAX:.0%}; a wrong object cannot be found: coloured by the trials\n"
    "that are not sure"
)

LineStyle = tuple[str, Any, float]  # colour, dashes, width


def by_contact(rows: Sequence[Row], path: Path) -> None:
    """A column for each object and condition: the median error above, the share of good ones below,
    a line a method."""
    columns = list(dict.fromkeys(map(_place, rows)))
    styles = line_styles(rows)
    down, across = -(-len(columns) // ACROSS), min(ACROSS, len(columns))
    figure = Figure(figsize=(max(2.2 * across, 5.0), 3.9 * down + 0.6), layout="constrained")
    panels = figure.subplots(2 * down, across, sharex=True, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for i, place in enumerate(columns):
        line, at = 2 * (i // ACROSS), i % ACROSS
        above, below = panels[line, at], panels[line + 1, at]
        mine = [row for row in rows if _place(row) == place]
        for axes, what in ((above, "error of the MAP [mm]"), (below, "trials found")):
            axes.set_axis_on()
            picture.plain(axes, 7)
            axes.tick_params(labelleft=at == 0)
            axes.set_ylabel(what if at == 0 else "", fontsize=8)
        for name, (colour, dashes, width) in styles.items():
            of = [row for row in mine if method(row) == name]
            x = [row["contact"] for row in of]
            error = np.clip([number(row["map_mm"]["median"]) for row in of], *SHOWN_MM)
            given = {"color": colour, "ls": dashes, "lw": width, "alpha": 0.9}
            above.plot(x, error, **given)
            below.plot(x, [row["found_rate"] for row in of], **given)
        above.axhline(FOUND_MM, color="0.45", lw=0.8, ls=":")
        above.set(yscale="log", ylim=SHOWN_MM)
        picture.log_ticks(above.yaxis, (1.0,))
        above.set_title("\n".join(place), fontsize=9, pad=3)
        below.set_ylim(0.0, 1.02)
        below.set_xticks(sorted({row["contact"] for row in mine}))
        below.set_xlabel("contacts", fontsize=8)
    handles = [
        Line2D([], [], color=colour, ls=dashes, lw=width, label=label)
        for label, (colour, dashes, width) in styles.items()
    ]
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=min(len(handles), across + 1),
        fontsize=8,
        frameon=False,
        columnspacing=1.5,
    )
    picture.save(figure, path, palette=True)


def line_styles(rows: Iterable[Row]) -> dict[str, LineStyle]:
    """Each method's colour by proposal, and dashes by injection; the adaptive one is thick."""
    rows = list(rows)
    colours = picture.styles(str(row["proposal"]) for row in rows)
    found: dict[str, LineStyle] = {}
    for row in rows:
        colour = OWN.get(row["proposal"], colours[row["proposal"]][0])
        width = 2.6 if row["particles_max"] > row["particles"] else 1.2
        found[method(row)] = (colour, DASHES[row["injection"]], width)
    return found


def failures(rows: Sequence[Row], path: Path) -> None:
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


def _place(row: Row) -> tuple[str, ...]:
    given = condition(row)
    name = object_name(str(row["object"]))
    return (name,) if given == "as assumed" else (name, given)


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
