"""The acceptance report's picture: noise over the skin, the scans' intervals, what presses read."""

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from taxeld.arrays import Floats
from taxeld.layout.draw import middle, plane
from taxeld_hil.acceptance.received import Received
from taxeld_hil.acceptance.report import AcceptanceReport

LABEL = {"boxstyle": "round,pad=0.1", "facecolor": "white", "alpha": 0.7, "linewidth": 0.0}
NOISE_LEAST = 0.1  # counts: less is drawn as this
MARKS = {"dead": "x", "stuck": "s", "saturated": "^", "noisy": "o", "not heard": "+"}


def draw(report: AcceptanceReport, out: Path) -> None:
    """Write the picture as PNG.

    Raises:
        OSError: `out` cannot be written.
    """
    got = report.received
    figure = Figure(figsize=(13.0, 4.2), layout="constrained")
    left, centre, right = figure.subplots(1, 3, width_ratios=(2.0, 1.0, 2.0))
    _noise(left, got)
    for hub, t in got.times.items():
        centre.hist(1e3 * np.diff(t), bins=60, histtype="step", label=f"hub {hub}", log=True)
        centre.legend(fontsize=7)
    centre.axvline(got.period_ms, color="0.6", lw=0.8, ls="--")
    centre.set_xlabel("ms between scans, asked dashed", fontsize=8)
    centre.set_title("rate", fontsize=9)
    if got.peak is None:
        right.set_axis_off()
        right.set_title("no presses (--press)", fontsize=9)
    else:
        _map(right, got, got.peak, "strongest press, counts over idle")
    for axes in (left, centre, right):
        axes.tick_params(labelsize=7, which="both")
    verdict = "failed" if report.failed else "passed"
    figure.suptitle(f"{got.layout.name} on {report.target}: {verdict}", fontsize=10)
    figure.savefig(out, dpi=90, format="png")


def _noise(axes: Axes, got: Received) -> None:
    """The noise of the taxels that can be used, and marks on those that fail."""
    idle, usable = got.idle, got.idle.usable
    noise = np.where(usable, np.maximum(idle.noise, NOISE_LEAST), np.nan)
    low, high = (np.nanmin(noise), np.nanmax(noise)) if usable.any() else (1.0, 1.0)
    _map(axes, got, noise, "idle noise, counts", LogNorm(low, max(high, 2.0 * low)))
    x, y = plane(got.layout.position_m, got.layout.radius_m)
    marked = {**idle.failing, "noisy": idle.noisy, "not heard": ~idle.present}
    for kind, mask in marked.items():
        if mask.any():
            axes.plot(x[mask], y[mask], MARKS[kind], mfc="none", mec="red", ms=7, label=kind)
            axes.legend(fontsize=7, loc="upper right")


def _map(axes: Axes, got: Received, value: Floats, title: str, norm: LogNorm | None = None) -> None:
    """One value (M,) a taxel over the unrolled skin, with the modules' serial numbers."""
    layout, serial = got.layout, got.layout.uid >> 4
    x, y = plane(layout.position_m, layout.radius_m)
    dots = axes.scatter(x, y, c=value, s=18, cmap="viridis", norm=norm)
    axes.figure.colorbar(dots, ax=axes, shrink=0.8).ax.tick_params(labelsize=7, which="both")
    for sui in np.unique(serial):
        at = middle(layout, serial == sui)
        axes.annotate(str(sui), at, fontsize=5, ha="center", va="center", bbox=LABEL)
    flat = math.isinf(layout.radius_m)
    axes.set_xlabel("x [mm]" if flat else "angle · radius [mm], from outside", fontsize=8)
    axes.set_ylabel("y [mm]" if flat else "z [mm]", fontsize=8)
    axes.set_title(title, fontsize=9)
    axes.set_aspect("equal", adjustable="datalim")
