"""The picture of `evaluate reliability`: do `p` and `radius_m` keep their word?"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from taxeld_training.charts import picture
from taxeld_training.jobs.promises import SURE, Promises, reliability

SHOWN_MM = (0.05, 300.0)  # errors and radii beyond are drawn at the edge, and wrong objects as well
CELLS = 48  # of the histogram along each axis
THRESHOLDS = 1.0 - np.geomspace(0.5, 1e-4, 60)  # of p


def draw(groups: Mapping[str, Promises], every: Promises, path: Path) -> None:
    """Left the share that is right by p, a curve a group; in the middle how many of `every` are
    sure, by threshold; right a Stanford diagram (as of satellite navigation) of those."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 0.8, 1.1))
    _curves(left, groups)
    _thresholds(middle, every)
    _stanford(figure, right, every)
    picture.save(figure, path, palette=True)


def _curves(axes: Axes, groups: Mapping[str, Promises]) -> None:
    """The share that is right, with its interval, over the mean p of each bin."""
    picture.plain(axes, 8)
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", lw=0.8, ls=":")
    for (name, given), colour, marker in zip(
        groups.items(), picture.COLOURS, picture.MARKERS, strict=False
    ):
        if not len(given):
            continue
        rows = reliability(given.p, given.right)
        x, y = (np.array([row[key] for row in rows]) for key in ("mean_p", "right"))
        low, high = np.array([row["right_ci"] for row in rows]).T
        spread = np.maximum([y - low, high - y], 0.0)
        label = f"{name} ({len(given)})"
        axes.errorbar(x, y, spread, label=label, color=colour, marker=marker, ms=4, elinewidth=0.4)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.set_xlabel("p", fontsize=9)
    axes.set_title("share of estimates that are right", fontsize=9)
    axes.legend(fontsize=7, frameon=False)


def _thresholds(axes: Axes, given: Promises) -> None:
    """Shares after the last contact, of runs with the object that the filter assumes."""
    picture.plain(axes, 8)
    last = given.of_object & (given.contact == given.contact.max(initial=0))
    if last.any():
        p, right = given.p[last], given.right[last]
        sure = p >= THRESHOLDS[:, None]
        axes.plot(1.0 - THRESHOLDS, (sure & right).mean(axis=1), color=picture.COLOURS[2])
        axes.plot(1.0 - THRESHOLDS, (sure & ~right).mean(axis=1), color=picture.COLOURS[1])
    axes.axvline(1.0 - SURE, color="0.6", lw=0.8, ls=":")
    axes.set(xscale="log", xlim=(0.5, 1e-4), ylim=(-0.02, 1.02))
    axes.set_xlabel("1 − threshold of p", fontsize=9)
    axes.set_title("sure after the last contact:\nright (green), wrong (red)", fontsize=9)


def _stanford(figure: Figure, axes: Axes, given: Promises) -> None:
    """Errors and radii of estimates that are sure; under the diagonal the radius is too small."""
    picture.plain(axes, 8)
    edges = np.geomspace(*SHOWN_MM, CELLS + 1)
    inside = SHOWN_MM[0] * 1.001, SHOWN_MM[1] * 0.999
    error = np.clip(np.nan_to_num(given.error_mm[given.sure], nan=np.inf), *inside)
    radius = np.clip(given.radius_mm[given.sure], *inside)
    axes.fill_between(SHOWN_MM, SHOWN_MM, SHOWN_MM[0], color=picture.COLOURS[1], alpha=0.12, lw=0)
    axes.plot(SHOWN_MM, SHOWN_MM, color=picture.COLOURS[1], lw=0.8)
    if len(error):
        counts, _, _ = np.histogram2d(error, radius, bins=(edges, edges))
        shown = np.ma.masked_equal(counts.T, 0.0)
        mesh = axes.pcolormesh(edges, edges, shown, cmap="viridis", norm=LogNorm(1.0))
        bar = figure.colorbar(mesh, ax=axes, shrink=0.8)
        bar.set_label("estimates", fontsize=8)
        bar.ax.tick_params(labelsize=7)
        picture.log_ticks(bar.ax.yaxis, (1.0, 2.0, 5.0))
    beyond, other = (int((given.sure & rule).sum()) for rule in (given.beyond, ~given.of_object))
    text = f"error > radius: {beyond} of {len(error)},\n{other} of them wrong objects"
    axes.text(0.97, 0.04, text, transform=axes.transAxes, ha="right", fontsize=8)
    axes.set(xscale="log", yscale="log", xlim=SHOWN_MM, ylim=SHOWN_MM)
    for axis in (axes.xaxis, axes.yaxis):
        picture.log_ticks(axis, (1.0,))
    axes.set_xlabel("error [mm]; wrong objects at the right edge", fontsize=9)
    axes.set_ylabel("radius_m [mm]", fontsize=9)
    axes.set_title(f"estimates with p ≥ {SURE:g}", fontsize=9)
