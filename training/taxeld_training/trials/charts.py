"""Pictures of answers; the same rows give the same bytes. matplotlib is imported here alone."""

from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

from taxeld_training.trials.tables import Row, word

# Okabe and Ito's colours, for colour-blind readers, without their yellow, which is too pale
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", ">")
DPI = 120
LINE_IN = 0.19  # height of a line of the map


def where(rows: Sequence[Row], path: Path) -> None:
    """A line for each condition: the shares of each object's trials that are found and sure at the
    end, with their intervals, and how many sure estimates mislead."""
    own = [row for row in rows if row["of"].keys() == {"object", "cell"}]
    cells = list(dict.fromkeys(row["of"]["cell"] for row in own))
    objects = list(dict.fromkeys(row["of"]["object"] for row in own))
    figure = Figure(figsize=(7.0, 1.2 + LINE_IN * len(cells)), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)
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


CHARTS: dict[str, Callable[[Sequence[Row], Path], None]] = {"map": where}


def _save(figure: Figure, path: Path) -> None:
    """Write a picture with a palette of 256 colours, as many faint lines would compress badly."""
    written, meta = BytesIO(), dict[str, Any](Software=None)
    figure.savefig(written, dpi=DPI, format="png", metadata=meta)
    # Quantised by coverage, rare colours stay.
    image = Image.open(written).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
    image.save(path, format="png", optimize=True)
