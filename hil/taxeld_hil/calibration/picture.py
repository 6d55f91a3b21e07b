"""A calibration's picture: gains and how well they are known, the response, and what is left."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taxeld.arrays import Floats
from taxeld.model import se2
from taxeld.model.response import GRID, response
from taxeld_hil.calibration.calibrate import Result

FIRM = 0.3  # weight of a reading: those below are not drawn beside the response
ARROW_M = 0.015  # length of a sensor's x axis


def draw(result: Result, out: Path) -> None:
    """Write the picture as PNG. Raises OSError."""
    c, known = result.calibration, result.known
    figure = Figure(figsize=(13.0, 6.4), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    gain = np.where(known, c.gain, np.nan)
    _map(axes[0], result, gain, "gain (grey: not touched enough)")
    _map(axes[1], result, 100.0 * np.minimum(c.gain_sd, 0.2), "its uncertainty, % (20 or more)")
    _map(axes[2], result, c.noise_counts, "noise at rest, counts")
    _response(axes[3], result)
    _readings(axes[4], result)
    _presses(axes[5], result)
    for one in axes:
        one.tick_params(labelsize=7)
    x, y, yaw = c.mount
    figure.suptitle(
        f"{c.object}, {c.presses} presses: full scale {c.full_scale_counts:.0f} counts; mount "
        f"{1e3 * x:+.2f} mm, {1e3 * y:+.2f} mm, {np.degrees(yaw):+.2f}°",
        fontsize=10,
    )
    figure.savefig(out, dpi=90, format="png")


def _map(axes: Axes, result: Result, value: Floats, title: str) -> None:
    layout = result.observed.model.layout
    x, y = 1e3 * layout.unrolled_m
    axes.scatter(x, y, c="0.8", s=18)
    dots = axes.scatter(x, y, c=value, s=18, cmap="viridis")
    axes.figure.colorbar(dots, ax=axes, shrink=0.8).ax.tick_params(labelsize=7)
    _label(axes, title, "angle · radius [mm]", "z [mm]")


def _response(axes: Axes, result: Result) -> None:
    c, fit = result.calibration, result.fit
    axes.plot(GRID, response(GRID[:, None], c.bend, c.onset[result.known]), color="0.85", lw=0.6)
    firm = (fit.weight > FIRM) & result.known
    reading = result.observed.presses.counts / (c.full_scale_counts * c.gain)
    axes.plot(fit.depth[firm], reading[firm], ".", ms=3, color="tab:blue")
    axes.plot(GRID, response(GRID, c.bend, np.zeros(1)), color="black", lw=1.2, label="common")
    axes.legend(fontsize=7)
    _label(axes, "response: reading over own full scale", "depth over full depth", "")


def _readings(axes: Axes, result: Result) -> None:
    fit, used = result.fit, result.fit.weight > 0.0
    expected, read = fit.expected()[used], result.observed.presses.counts[used]
    axes.scatter(expected, read, c=fit.weight[used], s=8, cmap="coolwarm_r", vmin=0, vmax=1)
    axes.axline((0.0, 0.0), slope=1.0, color="0.6", lw=0.8)
    _label(axes, "read against expected, counts (red: discounted)", "expected", "read")


def _presses(axes: Axes, result: Result) -> None:
    ring = se2.apply(result.fit.value.object, result.observed.model.scene.outline)
    axes.fill(1e3 * ring[:, 0], 1e3 * ring[:, 1], color="0.9", ec="0.4")
    sensor = se2.compose(result.observed.presses.sensor, result.calibration.mount)
    tip = se2.compose(sensor, np.array([ARROW_M, 0.0, 0.0]))
    x, y = 1e3 * np.stack([sensor, tip])[..., :2].transpose(2, 0, 1)
    axes.plot(x[0], y[0], "o", ms=4, mfc="none", color="tab:red")
    axes.plot(x, y, color="tab:red", lw=0.8)
    axes.set_aspect("equal", adjustable="datalim")
    _label(axes, "the sensor at each press, and its x axis", "world x [mm]", "")


def _label(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
