"""A calibration's picture: gains and how well they are known, the response, and what is left."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taxeld.arrays import Floats
from taxeld.commands.calibration_result import Result
from taxeld.layout.draw import plane
from taxeld.model import se2
from taxeld.model.response import GRID, response


def draw(result: Result, out: Path) -> None:
    """Write the picture as PNG. Raises OSError."""
    figure = Figure(figsize=(13.0, 6.4), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    c = result.calibration
    gain = np.where(result.known, c.gain, np.nan)
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
    layout = result.heard.model.layout
    x, y = plane(layout.position_m, layout.radius_m)
    axes.scatter(x, y, c="0.8", s=18)
    dots = axes.scatter(x, y, c=value, s=18, cmap="viridis")
    axes.figure.colorbar(dots, ax=axes, shrink=0.8).ax.tick_params(labelsize=7)
    axes.set_title(title, fontsize=9)
    axes.set_xlabel("angle · radius [mm]", fontsize=8)
    axes.set_ylabel("z [mm]", fontsize=8)


def _response(axes: Axes, result: Result) -> None:
    c, fit, presses = result.calibration, result.fit, result.heard.presses
    known = np.flatnonzero(result.known)
    for taxel in known:
        axes.plot(GRID, response(GRID, c.bend, c.onset[taxel]), color="0.85", lw=0.6)
    own = c.full_scale_counts * c.gain
    firm = fit.used & (fit.weight > 0.2) & result.known
    axes.plot(fit.depth[firm], (presses.counts / own)[firm], ".", ms=3, color="tab:blue")
    axes.plot(GRID, response(GRID, c.bend, np.zeros(1)), color="black", lw=1.2, label="common")
    axes.set_title("response: reading over own full scale", fontsize=9)
    axes.set_xlabel("depth over full depth", fontsize=8)
    axes.legend(fontsize=7)


def _readings(axes: Axes, result: Result) -> None:
    fit, presses = result.fit, result.heard.presses
    expected = fit.expected()
    used = fit.used
    axes.scatter(
        expected[used],
        presses.counts[used],
        c=fit.weight[used],
        s=8,
        cmap="coolwarm_r",
        vmin=0,
        vmax=1,
    )
    top = float(max(expected[used].max(), presses.counts[used].max()))
    axes.plot([0, top], [0, top], color="0.6", lw=0.8)
    axes.set_title("read against expected, counts (red: discounted)", fontsize=9)
    axes.set_xlabel("expected", fontsize=8)
    axes.set_ylabel("read", fontsize=8)


def _presses(axes: Axes, result: Result) -> None:
    """Where on the object each press was."""
    scene, presses = result.heard.model.scene, result.heard.presses
    ring = se2.apply(result.fit.object, scene.outline)
    axes.fill(1e3 * ring[:, 0], 1e3 * ring[:, 1], color="0.9", ec="0.4")
    sensor = se2.compose(presses.sensor, result.calibration.mount)
    axes.plot(1e3 * sensor[:, 0], 1e3 * sensor[:, 1], "o", ms=4, mfc="none", color="tab:red")
    for k, (x, y, yaw) in enumerate(sensor):
        axes.plot(
            1e3 * np.array([x, x + 0.015 * np.cos(yaw)]),
            1e3 * np.array([y, y + 0.015 * np.sin(yaw)]), color="tab:red", lw=0.7,
        )  # fmt: skip
        axes.annotate(str(k + 1), (1e3 * x, 1e3 * y), fontsize=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title("the sensor at each press, and its x axis", fontsize=9)
    axes.set_xlabel("world x [mm]", fontsize=8)
