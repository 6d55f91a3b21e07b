"""Scenes with closed forms, so that what the daemon computes can be checked by hand."""

from collections.abc import Callable

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout
from taxeld.model.scene import Scene

Distance = Callable[[Floats, Floats], Floats]

DEPTH_MAX_M = 0.005
CELL = 0.002


def scene_of(distance: Distance, skin: Layout, symmetry: int, half_m: float = 0.2) -> Scene:
    """A scene of the same signed distance function at every height."""
    heights = np.unique(skin.position_m[:, 2])
    at = np.arange(-half_m, half_m + CELL / 2, CELL)
    x, y = np.meshgrid(at, at)
    grid = distance(x, y).astype(np.float32)
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = 0.05 * np.column_stack([np.cos(angle), np.sin(angle)])
    surface = np.concatenate([np.column_stack([ring, np.full(64, z)]) for z in heights])
    return Scene(
        slices=np.stack([grid] * len(heights)),
        silhouette=grid,
        heights=heights,
        origin=np.array([-half_m, -half_m]),
        cell=CELL,
        outline=ring,
        surface=surface,
        symmetry=symmetry,
        centre=np.zeros(2),
    )


def disc(radius_m: float) -> Distance:
    return lambda x, y: np.hypot(x, y) - radius_m


def box(a: float, b: float) -> Distance:
    """Signed distance of a rectangle of half sides a and b."""

    def distance(x: Floats, y: Floats) -> Floats:
        dx, dy = np.abs(x) - a, np.abs(y) - b
        outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0))
        return outside + np.minimum(np.maximum(dx, dy), 0)

    return distance
