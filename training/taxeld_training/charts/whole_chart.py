"""The chart of whole filters: what a touch costs against how often the object is found for sure."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from taxeld_training.charts import picture
from taxeld_training.charts.picture import Style
from taxeld_training.jobs.rows import Row, condition, object_name

ACROSS = 5  # panels side by side
AFTER = 6  # touches
GIVEN: dict[str, Any] = {"ls": "none", "mfc": "none", "mec": "black"}
MARKS = {  # keys of rows → marker, size and name in the legend
    "ships": ("s", 10.0, "as it ships"),
    "enough": ("*", 13.0, "the cheapest shown to be as good as the best"),
}


def draw(rows: Sequence[Row], path: Path) -> None:
    """A panel for each object and condition, with the front of its filters. Those by the paper's
    rule are hollow."""
    style = picture.styles(row["proposal"] for row in rows)
    scenes = list(dict.fromkeys(map(_scene, rows)))
    across = min(ACROSS, len(scenes))
    down = -(-len(scenes) // across)
    size = max(2.1 * across, 6.0), 1.9 * down + 1.0
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
    for axes in panels.flat[len(scenes) :]:
        axes.set_axis_off()
    for k, (scene, axes) in enumerate(zip(scenes, panels.flat, strict=False)):
        _panel(axes, [row for row in rows if _scene(row) == scene], style)
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
    picture.save(figure, path, palette=True)


def _scene(row: Row) -> tuple[str, str]:
    return object_name(str(row["object"])), condition(row)


def _share(row: Row) -> float:
    return float(row["found_and_sure"][AFTER - 1] / row["trials"])


def _panel(axes: Axes, rows: Sequence[Row], style: dict[str, Style]) -> None:
    picture.plain(axes, 7)
    axes.set(xscale="log", ylim=(-0.03, 1.05))
    picture.log_ticks(axes.xaxis, (1.0, 2.0, 5.0))
    for row in rows:
        colour, marker = style[row["proposal"]]
        fill = "white" if row["injection"] == "paper" else colour
        given: dict[str, Any] = {"ms": 4.0, "mec": colour, "mfc": fill, "mew": 0.8, "alpha": 0.85}
        axes.plot(row["ms"], _share(row), marker, **given)
        for key, (mark, size, _) in MARKS.items():
            if row[key]:
                axes.plot(row["ms"], _share(row), mark, ms=size, zorder=4, **GIVEN)
    front = sorted((row["ms"], _share(row)) for row in rows if row["on_front"])
    if front:
        x, y = zip(*front, strict=True)
        last = max(row["ms"] for row in rows)
        axes.step([*x, last], [*y, y[-1]], where="post", color="0.5", lw=0.9, zorder=1)
