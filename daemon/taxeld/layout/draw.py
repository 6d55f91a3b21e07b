"""A layout as a picture: unrolled, coloured by module, beside its cross-section."""

import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout

MM = 1e3
NORMAL_MM = 6.0
COLOURS = 20


def draw(layout: Layout, out: Path) -> None:
    """Write the picture as PNG.

    Raises:
        OSError: `out` cannot be written.
    """
    sui, module = np.unique(layout.uid >> 4, return_inverse=True)
    colour = mpl.colormaps["tab20"](module % COLOURS)
    flat = math.isinf(layout.radius_m)
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
    left.scatter(*plane(layout.position_m, layout.radius_m), c=colour, s=22)
    for i, serial in enumerate(sui):
        # the middle of a module, found before unrolling cuts it in two
        middle = layout.position_m[module == i].mean(axis=0, keepdims=True)
        (x,), (y,) = plane(middle, layout.radius_m)
        left.annotate(str(serial), (x, y), fontsize=5, ha="center", va="center")
    left.set_xlabel("x [mm]" if flat else "angle · radius [mm]")
    left.set_ylabel("y [mm]" if flat else "z [mm]")
    left.set_title("as it lies" if flat else "unrolled, seen from outside", fontsize=9)
    across = [0, 2] if flat else [0, 1]
    begin = layout.position_m[:, across].T * MM
    end = begin + layout.normal[:, across].T * NORMAL_MM
    right.plot(*np.stack([begin, end], axis=1), color="0.75", lw=0.5, zorder=1)
    right.scatter(*begin, c=colour, s=8, zorder=2)
    if not flat:
        angle = np.linspace(0.0, 2.0 * np.pi, 200)
        radius = layout.radius_m * MM
        right.plot(radius * np.cos(angle), radius * np.sin(angle), "k--", lw=0.7, zorder=0)
    right.set_xlabel("x [mm]")
    right.set_ylabel("z [mm]" if flat else "y [mm]")
    right.set_title("from the side" if flat else "from above, the fitted circle dashed", fontsize=9)
    for axes in (left, right):
        axes.set_aspect("equal", adjustable="datalim")
        axes.tick_params(labelsize=7)
    figure.suptitle(f"{layout.name}: {len(layout)} taxels in {len(sui)} modules", fontsize=10)
    figure.savefig(out, dpi=110, format="png")


def plane(position_m: Floats, radius_m: float) -> tuple[Floats, Floats]:
    """Paper coordinates (n,), (n,) [mm] of positions (n, 3) [m]."""
    x, y, z = position_m.T * MM
    if math.isinf(radius_m):
        return x, y
    return np.arctan2(y, x) * radius_m * MM, z
