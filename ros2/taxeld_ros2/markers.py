"""The belief as RViz draws it: outlines of the modes, particles, and the skin."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from taxeld.arrays import Floats
from taxeld_ros2 import ros_types
from taxeld_ros2.cdr import Writer, Written

LINE_STRIP, POINTS = 4, 8
ADD, DELETE = 0, 2
LINE_M, POINT_M = 0.002, 0.003
BLUE, GREEN = (0.12, 0.47, 0.71), (0.17, 0.63, 0.17)
FAINTEST = 0.15  # of a mode or particle of hardly any weight
MODES_MAX = 5  # as the daemon sends


@dataclass
class Drawn:
    """One marker; without points it is taken away."""

    ns: str
    id: int
    type: int
    points: Floats  # (P, 3) in the frame
    rgba: tuple[float, float, float, float]
    colours: Floats  # (P, 4), or empty


class Markers(Written, ros_types.MarkerArray):
    """Ready to be sent."""


def written(t: float, frame: str, drawn: list[Drawn]) -> Markers:
    writer = Writer()
    writer.uint32(len(drawn))
    for marker in drawn:
        writer.header(t, frame)
        writer.string(marker.ns)
        writer.int32(marker.id, marker.type, ADD if len(marker.points) else DELETE)
        writer.float64(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # the pose, of no effect
        width = LINE_M if marker.type == LINE_STRIP else POINT_M
        writer.float64(width, width, 0.0)
        writer.float32(*marker.rgba)
        writer.int32(0)  # lives until it is replaced
        writer.uint32(0)
        writer.boolean(False)
        writer.points(marker.points)
        writer.colours(marker.colours)
        writer.string("")  # no texture
        writer.header(0.0, "")
        writer.string("")
        writer.nothing()
        writer.nothing()
        writer.string("")  # no text, no mesh
        writer.string("")
        writer.string("")
        writer.nothing()
        writer.boolean(False)
    return Markers(writer.done())


def markers(
    estimate: dict[str, Any], cloud: dict[str, Any], outline: Floats, frame: str, z_m: float
) -> Markers:
    """Modes of the estimate as outlines, the stronger the heavier, and particles as points; nothing
    of an estimate that is not valid. `cloud`: the particles, if any have come. `outline`: (P, 2) of
    the object, in its own frame."""
    shown = estimate["modes"] if estimate["valid"] else []
    closed = np.vstack([outline, outline[:1]])
    drawn = []
    for k in range(MODES_MAX):
        points, alpha = np.empty((0, 3)), 0.0
        if k < len(shown):
            points, alpha = _placed(closed, shown[k], z_m), max(shown[k]["weight"], FAINTEST)
        drawn.append(Drawn("modes", k, LINE_STRIP, points, (*BLUE, alpha), np.empty((0, 4))))
    particles = cloud if shown else {}
    drawn.append(_particles(particles, outline.mean(axis=0), z_m))
    return written(estimate["t"], frame, drawn)


def _particles(cloud: dict[str, Any], centre: Floats, z_m: float) -> Drawn:
    """Each at the object's centre."""
    poses = np.array(cloud.get("xytheta", ())).reshape(-1, 3)
    weight = np.array(cloud.get("weight", ()))
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = centre
    at = [poses[:, 0] + c * x - s * y, poses[:, 1] + s * x + c * y, np.full(len(poses), z_m)]
    colours = np.tile((*GREEN, 1.0), (len(poses), 1))
    colours[:, 3] = np.maximum(weight / weight.max(initial=1e-300), FAINTEST)
    return Drawn("particles", 0, POINTS, np.column_stack(at), (*GREEN, 1.0), colours)


def _placed(points: Floats, pose: dict[str, float], z_m: float) -> Floats:
    c, s = np.cos(pose["theta"]), np.sin(pose["theta"])
    x, y = points.T
    at = [pose["x"] + c * x - s * y, pose["y"] + s * x + c * y, np.full(len(points), z_m)]
    return np.column_stack(at)
