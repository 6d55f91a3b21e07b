"""The streams' maps as ROS 2 messages, as plain maps by the names of their fields.

Frames: `world`, that of the robot's poses, and `taxeld_sensor`, the skin's own.
"""

import math
from typing import Any

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.estimate import Status
from taxeld.view.stage import Stage

WORLD, SENSOR = "world", "taxeld_sensor"
FLOAT32, UINT8 = 7, 2  # sensor_msgs/PointField
OK, WARN, ERROR, STALE = range(4)  # diagnostic_msgs/DiagnosticStatus
LEVELS = {
    Status.CONVERGED: OK, Status.SEARCHING: OK, Status.AMBIGUOUS: OK, Status.STARTING: WARN,
    Status.BLIND: WARN, Status.INCONSISTENT: ERROR, Status.STALE: STALE,
}  # fmt: skip
POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("live", "u1")], align=True
)
FIELDS = [
    {"name": name, "offset": POINT.fields[name][1], "count": 1,  # type: ignore[index]
     "datatype": UINT8 if name == "live" else FLOAT32}
    for name in POINT.names or ()
]  # fmt: skip
IN_6X6 = [0, 1, 5]  # x, y and yaw among x, y, z, roll, pitch, yaw


def header(t: float, frame: str = WORLD) -> dict[str, Any]:
    ns = round(t * 1e9)
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": frame}


def pose(planar: dict[str, float]) -> dict[str, Any]:
    return {
        "position": {"x": planar["x"], "y": planar["y"], "z": 0.0},
        "orientation": _turned(planar["theta"]),
    }


def pose_with_covariance(e: dict[str, Any]) -> dict[str, Any]:
    """Mean and covariance of `/taxeld/estimate`; height, roll and pitch are known, so 0."""
    cov = np.zeros((6, 6))
    cov[np.ix_(IN_6X6, IN_6X6)] = e["cov"]
    held = {"pose": pose(e["mean"]), "covariance": cov.ravel().tolist()}
    return {"header": header(e["t"]), "pose": held}


def pose_array(t: float, poses: list[dict[str, float]]) -> dict[str, Any]:
    return {"header": header(t), "poses": [pose(one) for one in poses]}


def pose_stamped(t: float, planar: Poses) -> dict[str, Any]:
    x, y, theta = map(float, planar)
    return {"header": header(t), "pose": pose({"x": x, "y": y, "theta": theta})}


def transform(taxels: dict[str, Any]) -> dict[str, Any]:
    """The sensor's frame in the world, of `/taxeld/taxels`."""
    sensor = taxels["sensor"]
    moved = {
        "translation": {"x": sensor["x"], "y": sensor["y"], "z": 0.0},
        "rotation": _turned(sensor["theta"]),
    }
    one = {"header": header(taxels["t"]), "child_frame_id": SENSOR, "transform": moved}
    return {"transforms": [one]}


def point_cloud(stage: Stage, taxels: dict[str, Any]) -> dict[str, Any]:
    """The taxels with their activation as intensity, and whether they live."""
    points = np.zeros(len(stage.position_m), POINT)
    points["x"], points["y"], points["z"] = stage.position_m.T
    points["intensity"], points["live"] = taxels["z"], taxels["live"]
    return {
        "header": header(taxels["t"], SENSOR),
        "height": 1,
        "width": len(points),
        "fields": FIELDS,
        "is_bigendian": False,
        "point_step": POINT.itemsize,
        "row_step": points.nbytes,
        "data": points.tobytes(),
        "is_dense": True,
    }


def diagnostics(stage: Stage, e: dict[str, Any]) -> dict[str, Any]:
    """The status of `/taxeld/estimate`, and what has no place in a pose."""
    values = {
        "valid": e["valid"], "contact": e["contact"], "contacts": e["contacts"],
        "weights": " ".join(f"{mode['weight']:.4f}" for mode in e["modes"]),
        "ess": e["ess"], "particles": e["particles"], "injected": e["injected"],
        "proposal": stage.name("proposal", e["proposal"]), "log_evidence": e["log_evidence"],
    }  # fmt: skip
    status = {
        "level": LEVELS.get(e["status"], WARN),
        "name": "taxeld",
        "message": stage.name("status", e["status"]),
        "hardware_id": stage.layout,
        "values": [{"key": key, "value": str(value)} for key, value in values.items()],
    }
    return {"header": header(e["t"]), "status": [status]}


def _turned(theta: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": math.sin(0.5 * theta), "w": math.cos(0.5 * theta)}
