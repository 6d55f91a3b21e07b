"""The picture of `evaluate reliability`: do `p` and `radius_m` keep their word?"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taxeld.estimator.estimate import SURE
from taxeld_training.charts import picture, stanford_chart
from taxeld_training.jobs.promises import Promises, reliability

THRESHOLDS = 1.0 - np.geomspace(0.5, 1e-4, 60)  # of p


def draw(groups: Mapping[str, Promises], every: Promises, path: Path) -> None:
    """Left the share that is found by p, a curve a group; in the middle how many of `every` are
    sure, by threshold; right the Stanford diagram of those."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 0.8, 1.1))
    _curves(left, groups)
    _thresholds(middle, every)
    stanford_chart.panel(figure, right, every.stanford, "all")
    picture.save(figure, path, palette=True)


def _curves(axes: Axes, groups: Mapping[str, Promises]) -> None:
    """The share that is found, with its interval, over the mean p of each bin."""
    picture.plain(axes, 8)
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", lw=0.8, ls=":")
    for (name, given), colour, marker in zip(
        groups.items(), picture.COLOURS, picture.MARKERS, strict=False
    ):
        if not len(given):
            continue
        rows = reliability(given.p, given.found)
        x, y = (np.array([row[key] for row in rows]) for key in ("mean_p", "right"))
        low, high = np.array([row["right_ci"] for row in rows]).T
        spread = np.maximum([y - low, high - y], 0.0)
        label = f"{name} ({len(given)})"
        axes.errorbar(x, y, spread, label=label, color=colour, marker=marker, ms=4, elinewidth=0.4)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.set_xlabel("p", fontsize=9)
    axes.set_title("share of estimates that are found", fontsize=9)
    axes.legend(fontsize=7, frameon=False)


def _thresholds(axes: Axes, given: Promises) -> None:
    """Shares after the last contact, of runs with the object that the filter assumes."""
    picture.plain(axes, 8)
    last = given.of_object & (given.contact == given.contact.max(initial=0))
    if last.any():
        p, found = given.p[last], given.found[last]
        sure = p >= THRESHOLDS[:, None]
        axes.plot(1.0 - THRESHOLDS, (sure & found).mean(axis=1), color=picture.COLOURS[2])
        axes.plot(1.0 - THRESHOLDS, (sure & ~found).mean(axis=1), color=picture.COLOURS[1])
    axes.axvline(1.0 - SURE, color="0.6", lw=0.8, ls=":")
    axes.set(xscale="log", xlim=(0.5, 1e-4), ylim=(-0.02, 1.02))
    axes.set_xlabel("1 − threshold of p", fontsize=9)
    axes.set_title("sure after the last contact:\nfound (green), not found (red)", fontsize=9)
