"""A layout as a picture: unrolled, coloured by module, beside its cross-section."""

import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

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
    _unrolled(left, layout, flat, colour)
    for i, serial in enumerate(sui):
        # the middle of a module, found before unrolling cuts it in two
        middle = layout.position_m[module == i].mean(axis=0, keepdims=True)
        (x,), (y,) = plane(middle, layout.radius_m)
        left.annotate(str(serial), (x, y), fontsize=5, ha="center", va="center")
    _section(right, layout, flat, colour)
    for axes in (left, right):
        axes.set_aspect("equal", adjustable="datalim")
        axes.tick_params(labelsize=7)
    figure.suptitle(f"{layout.name}: {len(layout)} taxels in {len(sui)} modules", fontsize=10)
    figure.savefig(out, dpi=110, format="png")


def _unrolled(axes: Axes, layout: Layout, flat: bool, colour: NDArray[np.float64]) -> None:
    """Draw the taxels unrolled, in their colours (M, 4)."""
    x, y = plane(layout.position_m, layout.radius_m)
    axes.scatter(x, y, c=colour, s=22)
    axes.set_xlabel("x [mm]" if flat else "angle · radius [mm]")
    axes.set_ylabel("y [mm]" if flat else "z [mm]")
    axes.set_title("as it lies" if flat else "unrolled, seen from outside", fontsize=9)


def _section(axes: Axes, layout: Layout, flat: bool, colour: NDArray[np.float64]) -> None:
    """Draw the taxels and their normals across the axis, in their colours (M, 4)."""
    up = 2 if flat else 1
    x, y = layout.position_m[:, 0] * MM, layout.position_m[:, up] * MM
    dx, dy = layout.normal[:, 0] * NORMAL_MM, layout.normal[:, up] * NORMAL_MM
    axes.plot([x, x + dx], [y, y + dy], color="0.75", lw=0.5, zorder=1)
    axes.scatter(x, y, c=colour, s=8, zorder=2)
    if not flat:
        angle = np.linspace(0.0, 2.0 * np.pi, 200)
        radius = layout.radius_m * MM
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), "k--", lw=0.7, zorder=0)
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("z [mm]" if flat else "y [mm]")
    axes.set_title("from the side" if flat else "from above, the fitted circle dashed", fontsize=9)


def plane(
    position_m: NDArray[np.float64], radius_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Paper coordinates (n,), (n,) [mm] of positions (n, 3) [m]."""
    x, y, z = position_m.T * MM
    if math.isinf(radius_m):
        return x, y
    return np.arctan2(y, x) * radius_m * MM, z
