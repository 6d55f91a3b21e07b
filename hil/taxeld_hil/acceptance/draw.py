"""The acceptance report's picture: noise over the skin, the scans' intervals, what presses read."""

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from taxeld.arrays import Floats
from taxeld.layout.draw import middle, plane
from taxeld_hil.acceptance.link import rates
from taxeld_hil.acceptance.readings import IdleReadings
from taxeld_hil.acceptance.report import Report, strongest
from taxeld_hil.acceptance.taxels import failing, noisy
from taxeld_hil.acceptance.values import Received

LABEL = {"boxstyle": "round,pad=0.1", "facecolor": "white", "alpha": 0.7, "linewidth": 0.0}
NOISE_LEAST = 0.1  # counts: less is drawn as this
MARKS = {"dead": "x", "stuck": "s", "saturated": "^", "noisy": "o", "not heard": "+"}


def draw(report: Report, out: Path) -> None:
    """Write the picture as PNG.

    Raises:
        OSError: `out` cannot be written.
    """
    received, got = report.received, report.readings
    peak = strongest(received)
    figure = Figure(figsize=(13.0, 4.2), layout="constrained")
    left, centre, right = figure.subplots(1, 3, width_ratios=(2.0, 1.0, 2.0))
    _noise(left, received, got)
    _intervals(centre, received)
    if peak is None:
        right.set_axis_off()
        right.set_title("no presses (--press)", fontsize=9)
    else:
        _map(right, received, peak, "strongest press, counts over idle")
    for axes in (left, centre, right):
        axes.tick_params(labelsize=7, which="both")
    verdict = "passed" if report.passed else "failed"
    figure.suptitle(f"{received.layout.name} on {report.target}: {verdict}", fontsize=10)
    figure.savefig(out, dpi=90, format="png")


def _noise(axes: Axes, received: Received, got: IdleReadings) -> None:
    usable = got.present & ~np.any([*failing(got).values()], axis=0)
    noise = np.where(usable, np.maximum(got.noise, NOISE_LEAST), np.nan)
    low, high = (np.nanmin(noise), np.nanmax(noise)) if usable.any() else (1.0, 1.0)
    _map(axes, received, noise, "idle noise, counts", LogNorm(low, max(high, 2.0 * low)))
    x, y = plane(received.layout.position_m, received.layout.radius_m)
    groups = {
        **failing(got),
        "noisy": noisy(got, received.full_scale_counts),
        "not heard": ~got.present,
    }
    for kind, mask in groups.items():
        if mask.any():
            axes.plot(x[mask], y[mask], MARKS[kind], mfc="none", mec="red", ms=7, label=kind)
    if any(mask.any() for mask in groups.values()):
        axes.legend(fontsize=7, loc="upper right")


def _map(
    axes: Axes, received: Received, value: Floats, title: str, norm: LogNorm | None = None
) -> None:
    layout = received.layout
    x, y = plane(layout.position_m, layout.radius_m)
    dots = axes.scatter(x, y, c=value, s=18, cmap="viridis", norm=norm)
    axes.figure.colorbar(dots, ax=axes, shrink=0.8).ax.tick_params(labelsize=7, which="both")
    serial = layout.uid >> 4
    for sui in received.serials:
        at = middle(layout, serial == sui)
        axes.annotate(str(sui), at, fontsize=5, ha="center", va="center", bbox=LABEL)
    flat = math.isinf(layout.radius_m)
    axes.set_xlabel("x [mm]" if flat else "angle · radius [mm], from outside", fontsize=8)
    axes.set_ylabel("y [mm]" if flat else "z [mm]", fontsize=8)
    axes.set_title(title, fontsize=9)
    axes.set_aspect("equal", adjustable="datalim")


def _intervals(axes: Axes, received: Received) -> None:
    for hub, one in rates(received).items():
        axes.hist(1e3 * one.interval_s, bins=60, histtype="step", label=f"hub {hub}", log=True)
    axes.axvline(received.period_ms, color="0.6", lw=0.8, ls="--")
    axes.set_xlabel("ms between scans, asked dashed", fontsize=8)
    axes.set_title("rate", fontsize=9)
    if received.scans:
        axes.legend(fontsize=7)
