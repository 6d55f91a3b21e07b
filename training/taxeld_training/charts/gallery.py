"""A touch as a picture: the contacts that samplers generate for it, side by side."""

from collections.abc import Mapping
from pathlib import Path

import contourpy
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from taxeld.arrays import Floats, Poses
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import Scene
from taxeld_training.charts import picture

MM = 1e3
DRAWN = 100  # poses of each panel
INNER, OUTER = 0.45, 0.93  # radii of the lowest and the highest ring of taxels, of the skin's
TAXEL = 0.045  # radius of one, of the skin's
RULER_MM = 50.0
EDGE_MM = 4.0
LEVELS = 10  # of activation: few colours, so that the palette holds them
COLOURS = LinearSegmentedColormap.from_list("activation", ["#F4F4F4", "#E69F00", "#A83200"], LEVELS)


def gallery(
    model: ObservationModel, panels: Mapping[str, Poses], z: Floats, truth: Poses, path: Path
) -> None:
    """The object at the poses (n, 3) of each panel, all in the sensor frame, for a reading z (M,)
    of the pose `truth` (3,).

    The skin is seen from above, its rows as rings, the lowest innermost; below, it is unrolled.
    """
    loops = _loops(model.scene)
    true_lines = _placed(truth[None], loops)
    lines = {name: _placed(poses[:DRAWN], loops) for name, poses in panels.items()}
    radius = MM * model.layout.radius_m
    corners = np.array([[-radius, -radius], [radius, radius]])
    seen = np.concatenate([corners, *true_lines, *(line for of in lines.values() for line in of)])
    low, high = seen.min(axis=0) - EDGE_MM, seen.max(axis=0) + EDGE_MM

    width = 10.0 if len(panels) > 1 else 6.0
    tall = width / len(panels) * (high - low)[1] / (high - low)[0]
    figure = Figure(figsize=(width, tall + 2.0), layout="constrained")
    grid = figure.add_gridspec(2, len(panels), height_ratios=(tall, 1.0))
    for at, (name, poses) in enumerate(panels.items()):
        axes = figure.add_subplot(grid[0, at])
        axes.add_collection(
            LineCollection(lines[name], colors=picture.COLOURS[0], alpha=0.15, lw=0.7)
        )
        axes.add_collection(LineCollection(true_lines, colors="black", ls=(0, (4, 2)), zorder=3))
        _skin(axes, model.layout, z)
        residual = np.abs(model.activation(poses) - z).max(axis=1)
        axes.set_title(f"{name}\nobservation residual {np.median(residual):.2f}", fontsize=10)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_axis_off()
        if at == 0:
            _ruler(axes, low + EDGE_MM)
    axes.annotate(
        "dashed: the true pose", (1.0, 0.0), xycoords="axes fraction", ha="right", fontsize=8
    )
    _unrolled(figure.add_subplot(grid[1, :]), model.layout, z)
    picture.save(figure, path, palette=True)


def _loops(scene: Scene) -> list[Floats]:
    """The silhouette's outlines [mm]; a handle that no slice ties to its mug has its own."""
    lines = contourpy.contour_generator(z=scene.silhouette).lines(0.0)
    return [MM * (scene.origin + scene.cell * np.asarray(line)) for line in lines]


def _placed(poses: Poses, loops_mm: list[Floats]) -> list[Floats]:
    at = poses * np.array([MM, MM, 1.0])
    return [se2.apply(pose, loop) for loop in loops_mm for pose in at]


def _skin(axes: Axes, layout: Layout, z: Floats) -> None:
    """The cross-section, and the taxels in it."""
    radius = MM * layout.radius_m
    axes.add_patch(Circle((0.0, 0.0), radius, fc="white", ec="0.4", lw=1.0, zorder=2))
    x, y, height = layout.position_m.T
    low, high = height.min(), height.max()
    share = (height - low) / (high - low) if high > low else np.ones_like(height)
    ring = radius * (INNER + (OUTER - INNER) * share) / np.hypot(x, y)
    dots = [Circle(at, TAXEL * radius) for at in zip(ring * x, ring * y, strict=True)]
    taxels = PatchCollection(dots, cmap=COLOURS, ec="0.7", lw=0.25, zorder=4)
    taxels.set(array=z, clim=(0.0, 1.0))
    axes.add_collection(taxels)


def _unrolled(axes: Axes, layout: Layout, z: Floats) -> None:
    x, y, height = layout.position_m.T
    angle = np.degrees(np.arctan2(y, x))
    taxels = axes.scatter(
        angle, MM * height, c=z, s=32, cmap=COLOURS, vmin=0.0, vmax=1.0, ec="0.7", lw=0.4
    )
    axes.set_xlim(-190.0, 190.0)
    axes.set_xticks(range(-180, 181, 90))
    axes.margins(y=0.15)
    axes.set_xlabel("angle around the skin, 0° to the right [°]", fontsize=8)
    axes.set_ylabel("height [mm]", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    bar = axes.figure.colorbar(
        taxels, ax=axes, fraction=0.02, pad=0.01, aspect=8, ticks=(0, 0.5, 1)
    )
    bar.set_label("activation", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)


def _ruler(axes: Axes, corner: Floats) -> None:
    x, y = corner
    axes.plot([x, x + RULER_MM], [y, y], color="black", lw=2.0)
    axes.annotate(f"{RULER_MM:.0f} mm", (x, y), (0, 3), textcoords="offset points", fontsize=8)
