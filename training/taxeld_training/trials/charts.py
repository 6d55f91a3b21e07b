"""Pictures of answers, from their rows; matplotlib is imported here alone.

`front` says what a touch costs against how soon the object is found for sure, `where` in which
conditions that fails, `calibration` whether p keeps its word. The same rows give the same bytes.
"""

from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from PIL import Image

from taxeld_training.trials.tables import Row, word

# Okabe and Ito's colours, for colour-blind readers, without their yellow, which is too pale
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", ">")
DPI = 120
SHIPS = "table"
SIZED = "table "  # methods that differ in their particles alone
KEYS = "ms", "to_sure"  # of the axes of the front
LINE_IN = 0.19  # height of a line of the map


def front(rows: Sequence[Row], path: Path) -> None:
    """Processor time of a touch against touches until an object is found for sure, of all filters
    over all objects. A line joins those that differ in their size, a step the best."""
    every = [row for row in rows if row["of"].keys() == {"cell", "method"}]
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    axes = figure.subplots()
    _plain(axes)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("processor time of a touch [ms]", fontsize=9)
    axes.set_ylabel("touches until found and sure", fontsize=9)
    for row in every:
        name = row["of"]["method"]
        is_sized = name.startswith(SIZED)
        low, high = row["ci"]["to_sure"]
        x, y = row["ms"], row["to_sure"]
        colour = COLOURS[0] if is_sized else COLOURS[1] if name == SHIPS else COLOURS[6]
        axes.plot([x, x], [low, high], color=colour, lw=0.8, alpha=0.6)
        axes.plot(x, y, "o", color=colour, ms=9 if name == SHIPS else 5)
        label = name.removeprefix(SIZED) + " (ships)" * (name == SHIPS)
        away, unit = (0, -11) if is_sized else (5, 4), "offset points"
        axes.annotate(label, (x, y), away, textcoords=unit, fontsize=7, color=colour)
    best: list[Row] = []
    for row in sorted(every, key=lambda row: row["ms"]):
        if not best or row["to_sure"] < best[-1]["to_sure"]:
            best.append(row)
    if best:
        x, y = ([row[key] for row in best] for key in KEYS)
        last = max(row["ms"] for row in every)
        axes.step([*x, last], [*y, y[-1]], where="post", color="0.6", lw=0.9, zorder=0)
    sized = [row for row in every if row["of"]["method"].startswith(SIZED)]
    x, y = ([row[key] for row in sorted(sized, key=lambda row: row["ms"])] for key in KEYS)
    axes.plot(x, y, color=COLOURS[0], lw=1.0)
    _save(figure, path)


def where(rows: Sequence[Row], path: Path) -> None:
    """A line for each condition: the shares of each object's trials that are found and sure at the
    end, with their intervals, and how many sure estimates mislead."""
    own = [row for row in rows if row["of"].keys() == {"object", "cell"}]
    cells = list(dict.fromkeys(row["of"]["cell"] for row in own))
    objects = list(dict.fromkeys(row["of"]["object"] for row in own))
    size = 7.0, 1.2 + LINE_IN * len(cells)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    _plain(axes)
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
    _save(figure, path)


def calibration(rows: Sequence[Row], path: Path) -> None:
    """The share that is found over the mean p of each bin, a curve for each part of the trials."""
    figure = Figure(figsize=(5.0, 4.2), layout="constrained")
    axes = figure.subplots()
    _plain(axes)
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", lw=0.8, ls=":")
    parts = [row for row in rows if "part" in row["of"]]
    for row, colour, marker in zip(parts, COLOURS, MARKERS, strict=False):
        x, y = ([each[key] for each in row["bins"]] for key in ("mean_p", "right"))
        label = f"{row['of']['part']} ({row['estimates']})"
        axes.plot(x, y, label=label, color=colour, marker=marker, ms=4)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.set_xlabel("p", fontsize=9)
    axes.set_title("share of estimates that are found", fontsize=9)
    axes.legend(fontsize=7, frameon=False)
    _save(figure, path)


CHARTS: dict[str, Callable[[Sequence[Row], Path], None]] = {
    "front": front,
    "map": where,
    "calibration": calibration,
}


def _plain(axes: Axes) -> None:
    """No box, a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)


def _save(figure: Figure, path: Path) -> None:
    """Write a picture with a palette of 256 colours, as many faint lines would compress badly."""
    written, meta = BytesIO(), dict[str, Any](Software=None)
    figure.savefig(written, dpi=DPI, format="png", metadata=meta)
    # Quantised by coverage, rare colours stay.
    image = Image.open(written).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
    image.save(path, format="png", optimize=True)
