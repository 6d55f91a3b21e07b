"""Pictures of answers; the same rows give the same bytes. matplotlib is imported here alone.

`front` says what a touch costs and how soon an object is found for sure, `where` in which
conditions that fails.
"""

from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from PIL import Image

from taxeld_sim.answers.tables import Row, word

# Okabe and Ito's colours, for colour-blind readers, without their yellow, which is too pale
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", ">")
DPI = 120
LINE_IN = 0.19  # height of a line of the map
SHIPS = "table"
SIZED = "table "  # methods that differ in their particles alone
SHOWN = "002_master_chef_can", "003_cracker_box", "035_power_drill", "025_mug"
KEYS = "ms", "to_sure"  # of the axes of the front
AWAY = {SHIPS: (-60, -30), "density": (-52, 10)}  # of labels that others would cover [points]


def front(rows: Sequence[Row], path: Path) -> None:
    """Processor time of a touch against touches until the object is found for sure: above, of all
    filters over all objects, with a step along the best; below, of filters that differ in their
    particles alone, for single objects."""
    figure = Figure(figsize=(7.0, 7.4), layout="constrained")
    over_all, single = figure.subplots(2, sharex=True, height_ratios=(3, 2))
    _draw_filters(over_all, [row for row in rows if row["of"].keys() == {"cell", "method"}])
    each = [row for row in rows if row["of"].keys() == {"cell", "method", "object"}]
    for name, colour, marker in zip(SHOWN, COLOURS, MARKERS, strict=False):
        sized = _sized([row for row in each if row["of"]["object"] == name])
        if not sized:
            continue
        x, y = ([row[key] for row in sized] for key in KEYS)
        single.plot(x, y, marker=marker, color=colour, lw=1.0, ms=4, label=word(name))
        for row in sized:
            single.plot([row["ms"]] * 2, row["ci"]["to_sure"], color=colour, lw=0.8, alpha=0.5)
    single.set_title("single objects, with 25 to 800 particles", fontsize=10, loc="left")
    single.set_xlabel("processor time of a touch [ms]", fontsize=10)
    if single.lines:
        figure.legend(loc="outside lower center", ncols=len(SHOWN), fontsize=9, frameon=False)
    over_all.set_title("ten objects", fontsize=10, loc="left")
    for axes in (over_all, single):
        _plain(axes, 9)
        axes.set_xscale("log")
        axes.set_ylim(bottom=0.0)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0), numticks=20))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_ylabel("touches until found and sure", fontsize=10)
    save(figure, path)


def _draw_filters(axes: Axes, rows: Sequence[Row]) -> None:
    """A point for each filter, a line through those of several sizes, and a step along the best."""
    for row in rows:
        name = row["of"]["method"]
        is_sized = name.startswith(SIZED)
        x, y = (row[key] for key in KEYS)
        colour = COLOURS[0] if is_sized else COLOURS[1] if name == SHIPS else COLOURS[6]
        axes.plot([x, x], row["ci"]["to_sure"], color=colour, lw=1.0, alpha=0.6)
        axes.plot(x, y, "o", color=colour, ms=9 if name == SHIPS else 5)
        label = name.removeprefix(SIZED) + " (ships)" * (name == SHIPS)
        away = (-4, -14) if is_sized else AWAY.get(name, (6, 6))
        axes.annotate(label, (x, y), away, textcoords="offset points", fontsize=9, color=colour)
    best: list[Row] = []
    for row in sorted(rows, key=lambda row: row["ms"]):
        if not best or row["to_sure"] < best[-1]["to_sure"]:
            best.append(row)
    if best:
        x, y = ([row[key] for row in best] for key in KEYS)
        last = max(row["ms"] for row in rows)
        axes.step([*x, last], [*y, y[-1]], where="post", color="0.6", lw=0.9, zorder=0)
    x, y = ([row[key] for row in _sized(rows)] for key in KEYS)
    axes.plot(x, y, color=COLOURS[0], lw=1.0)


def _sized(rows: Sequence[Row]) -> list[Row]:
    """Those of filters that differ in their particles alone, by their cost."""
    found = [row for row in rows if row["of"]["method"].startswith(SIZED)]
    return sorted(found, key=lambda row: row["ms"])


def where(rows: Sequence[Row], path: Path) -> None:
    """A line for each condition: the shares of each object's trials that are found and sure at the
    end, with their intervals, and how many sure estimates mislead."""
    own = [row for row in rows if row["of"].keys() == {"object", "cell"}]
    cells = list(dict.fromkeys(row["of"]["cell"] for row in own))
    objects = list(dict.fromkeys(row["of"]["object"] for row in own))
    figure = Figure(figsize=(7.0, 1.2 + LINE_IN * len(cells)), layout="constrained")
    axes = figure.subplots()
    _plain(axes, 8)
    axes.set(xlim=(-3, 103), ylim=(len(cells) - 0.4, -0.6))
    axes.set_yticks(range(len(cells)), cells, fontsize=8)
    axes.set_xlabel("found and sure after the last touch [% of trials]", fontsize=9)
    for k, name in enumerate(objects[: len(COLOURS)]):
        shift = 0.3 * ((k + 0.5) / len(objects) - 0.5)
        for row in (row for row in own if row["of"]["object"] == name):
            y = cells.index(row["of"]["cell"]) + shift
            low, high = (100 * end for end in row["ci"]["found_and_sure"][-1])
            x = 100 * row["found_and_sure"][-1] / row["trials"]
            axes.plot([low, high], [y, y], color=COLOURS[k], lw=1.0, alpha=0.5)
            axes.plot(x, y, MARKERS[k], color=COLOURS[k], ms=4.5)
        axes.plot([], [], MARKERS[k], color=COLOURS[k], label=word(name))
    for y, cell in enumerate(cells):
        mine = [row for row in own if row["of"]["cell"] == cell]
        wrong, sure = (sum(row[key] for row in mine) for key in ("misleading", "sure"))
        weight = "bold" if wrong > 0.01 * sure else "normal"
        axes.text(105, y, f"{wrong} of {sure}", va="center", fontsize=8, weight=weight)
    axes.text(105, -1.0, "misleading", va="bottom", fontsize=8)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize=8, frameon=False)
    save(figure, path)


CHARTS: dict[str, Callable[[Sequence[Row], Path], None]] = {"front": front, "map": where}


def _plain(axes: Axes, size: int) -> None:
    """No box, a faint grid, and numbers of this size."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=size)
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)


def save(figure: Figure, path: Path) -> None:
    """Write a picture with a palette of 256 colours, as many faint lines would compress badly."""
    written, meta = BytesIO(), dict[str, Any](Software=None)
    figure.savefig(written, dpi=DPI, format="png", metadata=meta)
    # Quantised by coverage, rare colours stay.
    image = Image.open(written).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
    image.save(path, format="png", optimize=True)
