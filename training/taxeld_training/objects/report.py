"""What a skin meets of an object, and probable faults in how its mesh lies and is cut.

No doubt is an error: a lamp may hang and a rod may lie. But a mesh whose z axis does not point up,
or that is in another unit, gives a scene that is cut in the wrong places.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.scene import CONTINUOUS
from taxeld_sim.objects import meshes, scenes

LARGE_M = 1.0  # an object that is larger is probably not in metres
NEAR_M = 0.003  # vertices so near the lowest one carry the object: a scanned flat base is not flat
TIPS_M = 0.002  # an object tips over whose centre is so far outside the area that carries it
SHARE = 0.5  # share of its footprint on which an object stands well
BETTER = 2.0  # an object lies on its side if another one carries so many times as much


TURNS = {  # turn in words → its matrix
    "90° about x": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-90° about x": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "90° about y": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "-90° about y": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
}


def lines(name: str, layout: str, height_m: float, png: Path | None) -> Iterator[str]:
    """What the skin meets of a YCB id or a mesh file, also as a picture.

    Raises:
        SetupError: the object or the skin cannot be used, or the picture not be written.
    """
    skin, mesh = layouts.load(layout), meshes.load(meshes.find(name)[0])
    cut = scenes.build(mesh, skin, height_m)
    heights = (height_m + cut.heights) * 1e3
    met = sum(bool((piece < 0.0).any()) for piece in cut.slices)
    yield (
        "upright     the link's axis must be vertical (within 0.1 rad), and the object stand as "
        "its mesh does"
    )
    yield f"extents     {' × '.join(f'{length * 1e3:.0f}' for length in mesh.extents)} mm"
    yield (
        f"slices      {len(heights)}, {heights[0]:.0f} to {heights[-1]:.0f} mm above the lowest "
        f"point, {met} of which meet the object"
    )
    yield f"symmetry    {turns(cut.symmetry)}"
    yield f"repairs     {'; '.join(scenes.repairs(mesh, skin, height_m)) or 'none'}"
    yield f"grid        {(cut.slices.nbytes + cut.silhouette.nbytes) / 1e3:.0f} kB"
    if png:
        from taxeld_training.objects import picture  # noqa: PLC0415  (an extra)

        try:
            picture.draw(mesh, height_m + cut.heights, f"{name} on {skin.name}", png)
        except OSError as fault:
            raise SetupError(f"--png: cannot write {png} ({fault.strerror})") from None


def turns(symmetry: int) -> str:
    """The order of a rotation symmetry in words."""
    return {CONTINUOUS: "continuous", 1: "none"}.get(symmetry, f"{symmetry}-fold")


def doubts(mesh: trimesh.Trimesh, layout: Layout, height_m: float) -> list[str]:
    """Doubts about `mesh` on `layout`, whose frame's origin is `height_m` above its lowest
    point."""
    found = (_size(mesh), _side(mesh), _below(layout, height_m))
    return [line for line in found if line]


def _size(mesh: trimesh.Trimesh) -> str:
    size = float(mesh.extents.max())
    if size <= LARGE_M:
        return ""
    return (
        f"it is {size:.3g} m large; meshes are in metres: if this one is in millimetres, scale it "
        "by 0.001"
    )


def _side(mesh: trimesh.Trimesh) -> str:
    corners, centre = np.asarray(mesh.vertices), np.asarray(mesh.centroid)
    share, outside_m = _rest(corners, centre)
    turned = {name: _rest(corners @ turn.T, turn @ centre) for name, turn in TURNS.items()}
    standing = {name: share for name, (share, off_m) in turned.items() if off_m <= TIPS_M}
    name = max(standing, key=lambda turn: standing[turn], default="")
    best = standing.get(name, 0.0)
    tips = outside_m > TIPS_M
    if not tips and (share >= SHARE or best < BETTER * share):
        return ""
    what = "would tip over" if tips else f"rests on {share:.0%} of its footprint"
    cure = f"turn it by {name} if it lies on its side" if name else "turn it in your CAD program"
    return f"it {what}; the mesh's z axis must point up: {cure}"


def _rest(corners: NDArray[np.float64], centre: NDArray[np.float64]) -> tuple[float, float]:
    """How a body with these corners (n, 3) and this centre (3,) stands, z up: the share of its
    footprint that its lowest corners span, and how far its centre lies beside them [m]."""
    low = corners[:, 2] < corners[:, 2].min() + NEAR_M
    base = shapely.MultiPoint(corners[low, :2]).convex_hull
    footprint = shapely.MultiPoint(corners[:, :2]).convex_hull
    return base.area / footprint.area, float(base.distance(shapely.Point(centre[:2])))


def _below(layout: Layout, height_m: float) -> str:
    heights = height_m + layout.position_m[:, 2]
    under = heights < 0.0
    if not under.any():
        return ""
    return (
        f"{int(under.sum())} of {len(heights)} taxels lie below its lowest point, under a table "
        f"that it stands on, by up to {-heights.min() * 1e3:.0f} mm; give the true height: "
        f"--height-m {-layout.position_m[:, 2].min():.3f} or more"
    )
