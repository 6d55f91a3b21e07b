"""A Stanford diagram, as of satellite navigation: errors against what was claimed of them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from taxeld_hil.integrity import EDGES_MM, FOUND_MM, Stanford
from taxeld_training.charts import picture

MARKED = picture.COLOURS[1]  # the region of what misleads


def panel(figure: Figure, axes: Axes, diagram: Stanford, title: str) -> None:
    """Estimates that are sure by error and radius. What misleads is shaded: right of 10 mm, and
    below the diagonal. Each region has its count."""
    picture.plain(axes, 8)
    shown = EDGES_MM[0], EDGES_MM[-1]
    axes.axvspan(FOUND_MM, shown[1], color=MARKED, alpha=0.12, lw=0)
    axes.fill_between((shown[0], FOUND_MM), (shown[0], FOUND_MM), shown[0], fc=MARKED, alpha=0.12)
    axes.plot((shown[0], FOUND_MM, FOUND_MM), (shown[0], FOUND_MM, shown[1]), color=MARKED, lw=0.8)
    axes.plot((FOUND_MM, shown[1]), (FOUND_MM, shown[1]), color=MARKED, lw=0.8, ls=":")
    if diagram.sure:
        counts = np.ma.masked_equal(diagram.counts.T, 0.0)
        scale = LogNorm(1.0, max(float(counts.max()), 2.0))
        mesh = axes.pcolormesh(EDGES_MM, EDGES_MM, counts, cmap="viridis", norm=scale)
        bar = figure.colorbar(mesh, ax=axes, shrink=0.8)
        bar.ax.tick_params(labelsize=7)
        picture.log_ticks(bar.ax.yaxis, (1.0,))
    for x, y, count, side in (
        (0.03, 0.95, diagram.kept, "left"),
        (0.40, 0.05, diagram.beyond, "right"),
        (0.68, 0.95, diagram.far, "left"),
        (0.97, 0.05, diagram.far_beyond, "right"),
    ):
        axes.text(x, y, f"{count}", transform=axes.transAxes, ha=side, va="center", fontsize=8)
    axes.set(xscale="log", yscale="log", xlim=shown, ylim=shown)
    for axis in (axes.xaxis, axes.yaxis):
        picture.log_ticks(axis, (1.0,))
    axes.set_xlabel("error [mm]; other objects at the right edge", fontsize=8)
    axes.set_ylabel("radius_m [mm]", fontsize=8)
    axes.set_title(f"{title}: {diagram.misleading} of {diagram.sure} sure mislead", fontsize=9)
