"""The picture of `evaluate reliability`: do `p` and `radius_m` keep their word?"""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taxeld_hil.integrity import Stanford
from taxeld_training.charts import picture, stanford_chart
from taxeld_training.jobs.rows import Row


def draw(over: Sequence[Row], single: Sequence[Row], path: Path) -> None:
    """Left the share that is found by p, a curve for each row in `over`; right the Stanford diagram
    of the rows of `single` cells."""
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    _curves(left, over)
    every = Stanford.of_rows(row["stanford"] for row in single)
    stanford_chart.panel(figure, right, every, "all")
    picture.save(figure, path, palette=True)


def _curves(axes: Axes, over: Sequence[Row]) -> None:
    """The share that is found over the mean p of each bin."""
    picture.plain(axes, 8)
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", lw=0.8, ls=":")
    for row, colour, marker in zip(over, picture.COLOURS, picture.MARKERS, strict=False):
        x, y = ([each[key] for each in row["reliability"]] for key in ("mean_p", "right"))
        label = f"{row['over']} ({row['estimates']})"
        axes.plot(x, y, label=label, color=colour, marker=marker, ms=4)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.set_xlabel("p", fontsize=9)
    axes.set_title("share of estimates that are found", fontsize=9)
    axes.legend(fontsize=7, frameon=False)
