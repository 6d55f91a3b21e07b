"""The picture of `evaluate advice`: how soon an object is found, by who says where to touch."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taxeld_training.charts import picture
from taxeld_training.jobs.rows import Row, object_name

ACROSS = 3
PANEL_IN = 2.9


def draw(rows: Sequence[Row], path: Path) -> None:
    """A panel an object and condition: the share of trials that are right and sure after each
    touch, a line a guide."""
    panels: dict[tuple[str, str, bool], list[Row]] = {}
    for row in rows:
        panels.setdefault((row["object"], row["cell"], row["alike"]), []).append(row)
    down = -(-len(panels) // ACROSS)
    figure = Figure(figsize=(PANEL_IN * ACROSS, PANEL_IN * 0.8 * down + 0.5), layout="constrained")
    axes = figure.subplots(down, ACROSS, squeeze=False).ravel()
    style = picture.styles(row["guide"] for row in rows)
    for one, ((name, cell, alike), mine) in zip(axes, panels.items(), strict=False):
        _panel(one, mine, style)
        which = "which of two boxes" if alike else object_name(name)
        one.set_title(f"{which}, {cell} ({mine[0]['trials']})", fontsize=8)
    for one in axes[len(panels) :]:
        one.set_visible(False)
    picture.legend(figure, style, "upper")
    picture.save(figure, path, palette=True)


def _panel(axes: Axes, rows: Sequence[Row], style: dict[str, picture.Style]) -> None:
    picture.plain(axes, 7)
    for row in rows:
        colour, marker = style[row["guide"]]
        share = row["found_and_sure"]
        axes.plot(range(1, len(share) + 1), share, color=colour, marker=marker, ms=3, lw=1.0)
    axes.axhline(0.9, color="0.6", lw=0.8, ls=":")
    axes.set(ylim=(-0.02, 1.02))
    axes.set_xlabel("touches", fontsize=7)
