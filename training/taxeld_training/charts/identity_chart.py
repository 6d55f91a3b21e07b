"""The picture of `evaluate recognise`: which object is taken for which, and how far to trust it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taxeld_training.charts import picture
from taxeld_training.jobs.rows import Row, object_name

NONE = "none of them"
PANEL_IN = 3.3
LEAST = 0.005  # smaller shares have no number
DARK = 0.55  # share from which the number is white


def draw(rows: Sequence[Row], path: Path) -> None:
    """A line a skin: confusion after each contact that has a matrix, then how often the named
    object is right by its probability."""
    skins = list(dict.fromkeys(row["skin"] for row in rows))
    of = {
        skin: {
            figure: [row for row in rows if (row["skin"], row["figure"]) == (skin, figure)]
            for figure in ("confusion", "calibration")
        }
        for skin in skins
    }
    across = max((len(each["confusion"]) for each in of.values()), default=0) + 1
    size = (PANEL_IN * across, PANEL_IN * max(len(skins), 1))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(max(len(skins), 1), across, squeeze=False)
    for line, each in zip(panels, of.values(), strict=False):
        for axes, row in zip(line, each["confusion"], strict=False):
            _matrix(axes, row, is_first=axes is line[0])
        _reliability(line[-1], each["calibration"][0])
    picture.save(figure, path, palette=True)


def _matrix(axes: Axes, row: Row, *, is_first: bool) -> None:
    """A line for each touched object, a column for each likeliest one, in hundredths of the
    runs."""
    names = [*map(object_name, row["names"]), NONE]
    shares = np.array(row["shares"], dtype=np.float64)
    axes.imshow(np.nan_to_num(shares), cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for (i, k), share in np.ndenumerate(shares):
        if share >= LEAST:
            colour = "white" if share > DARK else "black"
            axes.text(k, i, f"{100 * share:.0f}", ha="center", va="center", size=6, color=colour)
    ticks = list(range(len(names)))
    axes.set_xticks(ticks, names, rotation=90, fontsize=6)
    axes.set_yticks(ticks, [*names[:-1], "unknown"] if is_first else [""] * len(names), fontsize=6)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_title(f"{row['skin']}, {row['contact']} touches", fontsize=9)


def _reliability(axes: Axes, row: Row) -> None:
    """The share of estimates whose object is right, over the mean probability of each bin."""
    picture.plain(axes, 7)
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", lw=0.8, ls=":")
    x, y = (np.array([each[key] for each in row["reliability"]]) for key in ("mean_p", "right"))
    axes.plot(x, y, color=picture.COLOURS[0], marker="o", ms=4)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.set_xlabel("probability of the named object", fontsize=8)
    axes.set_title(f"share that is right (error {row['ece']:.3f})", fontsize=9)
