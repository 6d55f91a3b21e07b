"""An object as a picture: from the side, with the heights of a skin's taxels, and from above."""

from pathlib import Path

import trimesh
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from taxeld.arrays import Floats


def draw(mesh: trimesh.Trimesh, heights_m: Floats, title: str, out: Path) -> None:
    """Write the picture as PNG; `heights_m` (K,): of the taxels above the lowest point.

    Raises:
        OSError: `out` cannot be written.
    """
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    corners = (mesh.triangles - [0.0, 0.0, mesh.bounds[0][2]]) * 1e3  # mm
    views = ("from the side", "height", 2), ("from above", "y", 1)
    for axes, (name, upwards, column) in zip(figure.subplots(1, 2), views, strict=True):
        triangles = corners[:, :, [0, column]]
        axes.add_collection(PolyCollection([*triangles], fc="0.7", ec="0.5", lw=0.2))
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.15)
        axes.autoscale_view()
        axes.set(title=name, xlabel="x of the mesh [mm]", ylabel=f"{upwards} [mm]")
        for height in heights_m if column == 2 else ():
            axes.axhline(1e3 * height, color="C0", lw=1.0)
    figure.suptitle(f"{title}; lines: the heights of the taxels", fontsize=10)
    figure.savefig(out, dpi=110, format="png", metadata={"Software": None})
