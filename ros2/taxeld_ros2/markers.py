"""The belief as RViz draws it: outlines of the modes, and particles."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model import se2
from taxeld.view import ros

LINE_STRIP, POINTS = 4, 8  # types of a visualization_msgs/Marker
ADD, DELETE = 0, 2  # actions of a marker
LINE_M, POINT_M = 0.002, 0.003
BLUE, GREEN = (0.12, 0.47, 0.71), (0.17, 0.63, 0.17)
FAINTEST = 0.15  # opacity of a mode of hardly any weight
MODES_MAX = 5  # modes in the daemon's estimates, at most


def markers(
    estimate: ros.Map, cloud: ros.Map, outlines: Sequence[Floats], frame: str, z_m: float
) -> dict[str, Any]:
    """A `MarkerArray`: modes of the estimate as outlines, the stronger the heavier, and particles
    as points; nothing of an estimate that is not valid.

    `cloud`: `/taxeld/particles`, or empty. `outlines`: (P, 2) of each object, in its own frame.
    """
    header = ros.header(estimate["t"], frame)
    modes = estimate["modes"] if estimate["valid"] else []
    drawn = []
    for k in range(MODES_MAX):
        points, alpha = np.empty((0, 2)), 0.0
        if k < len(modes):
            mode, outline = modes[k], outlines[modes[k]["object"]]
            closed = np.vstack([outline, outline[:1]])
            points = se2.apply(np.array([mode["x"], mode["y"], mode["theta"]]), closed)
            alpha = max(mode["weight"], FAINTEST)
        drawn.append(_marker("modes", k, LINE_STRIP, LINE_M, points, z_m, (*BLUE, alpha)))
    poses: Poses = np.array(cloud["xytheta"] if cloud and modes else ()).reshape(-1, 3)
    centre = np.array([*outlines[estimate["object"]].mean(axis=0), 0.0])
    points = se2.compose(poses, centre)[:, :2]
    drawn.append(_marker("particles", 0, POINTS, POINT_M, points, z_m, (*GREEN, 1.0)))
    return {"markers": [{"header": header, **one} for one in drawn]}


def _marker(
    ns: str, number: int, kind: int, size_m: float, points: Floats, z_m: float, rgba: Any
) -> ros.Map:
    """A marker of points (P, 2); without points it is taken away."""
    return {
        "ns": ns,
        "id": number,
        "type": kind,
        "action": ADD if len(points) else DELETE,
        "pose": ros.pose({"x": 0.0, "y": 0.0, "theta": 0.0}),
        "scale": {"x": size_m, "y": size_m},
        "color": dict(zip("rgba", rgba, strict=True)),
        "points": [{"x": x, "y": y, "z": z_m} for x, y in points.tolist()],
    }
