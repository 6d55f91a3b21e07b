"""The picture of `evaluate reliability`: does `p` keep its word?"""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from taxeld_training.charts import picture
from taxeld_training.jobs.rows import Row


def draw(over: Sequence[Row], path: Path) -> None:
    """The share that is found over the mean p of each bin, a curve for each row."""
    figure = Figure(figsize=(5.0, 4.2), layout="constrained")
    axes = figure.subplots()
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
    picture.save(figure, path, palette=True)
