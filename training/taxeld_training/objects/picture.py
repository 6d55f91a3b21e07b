"""A scene as a picture: the object with the skin's heights, and the outlines that are cut there."""

import math
from pathlib import Path

import matplotlib as mpl
import matplotlib.patches
import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from shapely.affinity import scale
from shapely.geometry.base import BaseGeometry
from shapely.plotting import patch_from_polygon

from taxeld.layout.layout import Layout
from taxeld.model.scene import CONTINUOUS, Scene
from taxeld_sim.objects import scenes
from taxeld_training.objects.report import turns

MM = 1e3
ROOM = 0.25  # share of the object's width that is left beside it for the heights' labels


def draw(
    mesh: trimesh.Trimesh, scene: Scene, layout: Layout, height_m: float, title: str, out: Path
) -> None:
    """Write the picture as PNG.

    Raises:
        OSError: `out` cannot be written.
    """
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    side, top = figure.subplots(1, 2)
    cuts = [outline.shape for outline in scenes.outlines(mesh, layout, height_m)]
    colour = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, len(cuts)))
    _from_the_side(side, mesh, height_m, scene.heights, cuts, colour)
    _from_above(top, scene, layout, cuts, colour)
    for axes in (side, top):
        axes.set_aspect("equal", adjustable="datalim")
        axes.tick_params(labelsize=7)
    figure.suptitle(title, fontsize=10)
    figure.savefig(out, dpi=110, format="png", metadata={"Software": None})


def _from_the_side(
    axes: Axes,
    mesh: trimesh.Trimesh,
    height_m: float,
    heights: NDArray[np.float64],
    cuts: list[BaseGeometry],
    colour: NDArray[np.float64],
) -> None:
    corners = mesh.triangles[:, :, [0, 2]] * MM
    corners[:, :, 1] -= mesh.bounds[0][2] * MM
    axes.add_collection(PolyCollection(list(corners), facecolors="0.8", edgecolors="none"))
    left, right = mesh.bounds[0][0] * MM, mesh.bounds[1][0] * MM
    room = ROOM * (right - left)
    for z, cut, line in zip((height_m + heights) * MM, cuts, colour, strict=True):
        style = "--" if cut.is_empty else "-"
        axes.plot([left - room, right + room], [z, z], style, color=line, lw=1.5)
        text = f"{z:.0f} mm{', misses it' if cut.is_empty else ''}"
        axes.annotate(text, (right + room, z), fontsize=7, ha="right", va="bottom")
    axes.axhline(0.0, color="k", lw=0.8)
    axes.annotate("lowest point", (left - room, 0.0), fontsize=7, va="bottom")
    axes.plot([left - room], [height_m * MM], "k>", ms=6)
    axes.annotate("  sensor frame", (left - room, height_m * MM), fontsize=7, va="bottom")
    axes.margins(0.15, 0.1)
    axes.autoscale_view()
    axes.set_xlabel("x of the mesh [mm]")
    axes.set_ylabel("height above the lowest point [mm]")
    axes.set_title("from the side, with the heights of the taxels", fontsize=9)


def _from_above(
    axes: Axes, scene: Scene, layout: Layout, cuts: list[BaseGeometry], colour: NDArray[np.float64]
) -> None:
    for cut, line in zip(cuts, colour, strict=True):
        for part in getattr(cut, "geoms", [cut]):
            if not part.is_empty:
                in_mm = scale(part, MM, MM, origin=(0.0, 0.0))
                axes.add_patch(patch_from_polygon(in_mm, facecolor="none", edgecolor=line, lw=1.5))
    x, y = scene.centre * MM
    axes.plot([x], [y], "k+", ms=8)
    reach = scene.reach * MM
    if scene.symmetry not in (1, CONTINUOUS):
        for k in range(scene.symmetry):
            angle = 2.0 * np.pi * k / scene.symmetry
            axes.plot([x, x + reach * np.cos(angle)], [y, y + reach * np.sin(angle)], "k:", lw=0.8)
    if math.isfinite(layout.radius_m):
        radius = layout.radius_m * MM
        beside = np.concatenate(scene.outlines)[:, 0].max() * MM + 1.2 * radius
        axes.add_patch(mpl.patches.Circle((beside, y), radius, fill=False, ls="--", color="0.5"))
        axes.annotate("the link", (beside, y), fontsize=7, ha="center", va="center")
    axes.margins(0.1)
    axes.autoscale_view()
    axes.set_xlabel("x of the mesh [mm]")
    axes.set_ylabel("y of the mesh [mm]")
    axes.set_title(f"from above: what is cut; symmetry: {turns(scene.symmetry)}", fontsize=9)
