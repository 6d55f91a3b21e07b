"""A calibration's picture: gains and how well they are known, the response, and what is left."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from taxeld.model import se2
from taxeld.model.response import GRID, response
from taxeld_hil.calibration.calibrate import Result

FIRM = 0.3  # weight of a reading: those below are not drawn beside the response
ARROW_M = 0.015  # length of a sensor's x axis
LABELS = [  # title, and what the axes show
    ("gain (grey: not touched enough)", "angle · radius [mm]", "z [mm]"),
    ("its uncertainty, % (20 or more)", "angle · radius [mm]", "z [mm]"),
    ("noise at rest, counts", "angle · radius [mm]", "z [mm]"),
    ("response: reading over own full scale", "depth over full depth", ""),
    ("read against expected, counts (red: discounted)", "expected", "read"),
    ("the sensor at each press, and its x axis", "world x [mm]", ""),
]


def draw(result: Result, out: Path) -> None:
    """Write the picture as PNG. Raises OSError."""
    c, known, fit, presses = result.calibration, result.known, result.fit, result.presses
    figure = Figure(figsize=(13.0, 6.4), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    maps = np.where(known, c.gain, np.nan), 100.0 * np.minimum(c.gain_sd, 0.2), c.noise_counts
    taxels = 1e3 * result.model.layout.unrolled_m
    for one, values in zip(axes, maps, strict=False):
        one.scatter(*taxels, c="0.8", s=18)
        dots = one.scatter(*taxels, c=values, s=18, cmap="viridis")
        figure.colorbar(dots, ax=one, shrink=0.8).ax.tick_params(labelsize=7)
    curves, readings, places = axes[3:]
    curves.plot(GRID, response(GRID[:, None], c.bend, c.onset[known]), color="0.85", lw=0.6)
    firm, share = (fit.weight > FIRM) & known, presses.counts / (c.full_scale_counts * c.gain)
    curves.plot(fit.depth[firm], share[firm], ".", ms=3, color="tab:blue")
    curves.plot(GRID, response(GRID, c.bend, np.zeros(1)), color="black", lw=1.2, label="common")
    curves.legend(fontsize=7)
    used = fit.weight > 0.0
    expected, read, weight = fit.expected[used], presses.counts[used], fit.weight[used]
    readings.scatter(expected, read, c=weight, s=8, cmap="coolwarm_r", vmin=0.0, vmax=1.0)
    readings.axline((0.0, 0.0), slope=1.0, color="0.6", lw=0.8)
    for outline in result.model.scene.outlines:
        ring = 1e3 * se2.apply(fit.value.object, outline)
        places.fill(*ring.T, color="0.9", ec="0.4")
    sensor = se2.compose(presses.sensor, c.mount)
    tip = se2.compose(sensor, np.array([ARROW_M, 0.0, 0.0]))
    x, y = 1e3 * np.stack([sensor, tip])[..., :2].transpose(2, 0, 1)
    places.plot(x[0], y[0], "o", ms=4, mfc="none", color="tab:red")
    places.plot(x, y, color="tab:red", lw=0.8)
    places.set_aspect("equal", adjustable="datalim")
    for one, (title, across, up) in zip(axes, LABELS, strict=True):
        one.set_title(title, fontsize=9)
        one.set_xlabel(across, fontsize=8)
        one.set_ylabel(up, fontsize=8)
        one.tick_params(labelsize=7)
    figure.suptitle(f"{c.object}, {c.presses} presses", fontsize=10)
    figure.savefig(out, dpi=90, format="png")
