"""The daemon's streams as ROS 2 messages: plain maps by the names of their fields.

The MCAP export and the bridge `taxeld_ros2` both send these. Fields that are left out are zero or
empty. Lengths are metres, angles radians, times Unix seconds.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.estimate import ProposalKind, Status
from taxeld.stream import messages

Map = dict[str, Any]

WORLD, SENSOR = "world", "taxeld_sensor"  # the frame of the robot's poses, and the skin's own
FLOAT32, UINT8 = 7, 2  # sensor_msgs/PointField
OK, WARN, STALE = 0, 1, 3  # diagnostic_msgs/DiagnosticStatus
LEVELS = {
    Status.STARTING: WARN,
    Status.SEARCHING: OK,
    Status.AMBIGUOUS: OK,
    Status.CONVERGED: OK,
    Status.BLIND: WARN,
    Status.STALE: STALE,
    Status.INCONSISTENT: WARN,
}
SILENT = "the daemon is silent"
POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("live", "u1")], align=True
)
IN_6X6 = [0, 1, 5]  # x, y and yaw among x, y, z, roll, pitch, yaw


def header(t: float, frame: str = WORLD) -> Map:
    ns = round(t * 1e9)
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": frame}


def pose(planar: Map, z_m: float = 0.0) -> Map:
    """A `geometry_msgs/Pose` of `x`, `y`, `theta`."""
    position = {"x": planar["x"], "y": planar["y"], "z": z_m}
    return {"position": position, "orientation": _turned(planar["theta"])}


def pose_with_covariance(e: Map, frame: str = WORLD, z_m: float = 0.0) -> Map:
    """Mean and covariance of `/taxeld/estimate`; height, roll and pitch are certain, so 0."""
    cov = np.zeros((6, 6))
    cov[np.ix_(IN_6X6, IN_6X6)] = e["cov"]
    held = {"pose": pose(e["mean"], z_m), "covariance": cov.ravel().tolist()}
    return {"header": header(e["t"], frame), "pose": held}


def pose_array(t: float, poses: Iterable[Map], frame: str = WORLD, z_m: float = 0.0) -> Map:
    return {"header": header(t, frame), "poses": [pose(one, z_m) for one in poses]}


def pose_stamped(t: float, planar: Poses) -> Map:
    """`planar`: (3,) x, y, yaw."""
    x, y, theta = map(float, planar)
    return {"header": header(t), "pose": pose({"x": x, "y": y, "theta": theta})}


def transform(taxels: Map) -> Map:
    """The sensor's frame in the world, of `/taxeld/taxels`."""
    sensor = taxels["sensor"]
    moved = {
        "translation": {"x": sensor["x"], "y": sensor["y"], "z": 0.0},
        "rotation": _turned(sensor["theta"]),
    }
    one = {"header": header(taxels["t"]), "child_frame_id": SENSOR, "transform": moved}
    return {"transforms": [one]}


def point_cloud(taxels: Map, position_m: Floats) -> Map:
    """The taxels at `position_m` (M, 3), with their activation as intensity, and which live."""
    points = np.zeros(len(position_m), POINT)
    points["x"], points["y"], points["z"] = position_m.T
    points["intensity"], points["live"] = taxels["z"], taxels["live"]
    kinds = {name: UINT8 if name == "live" else FLOAT32 for name in POINT.names or ()}
    offsets = {name: POINT.fields[name][1] for name in kinds}  # type: ignore[index]
    return {
        "header": header(taxels["t"], SENSOR),
        "height": 1,
        "width": len(points),
        "fields": [
            {"name": name, "offset": offsets[name], "datatype": kind, "count": 1}
            for name, kind in kinds.items()
        ],
        "is_bigendian": False,
        "point_step": POINT.itemsize,
        "row_step": points.nbytes,
        "data": points.tobytes(),
        "is_dense": True,
    }


def diagnostics(t: float, name: str, e: Map, health: Map | None = None, hardware: str = "") -> Map:
    """The status of an estimate, and what has no place in a pose; `e` is empty where no daemon is
    heard. `health` adds what a technician asks first."""
    level, message, values = STALE, SILENT, {}
    if e:
        level = LEVELS.get(e["status"], WARN)
        message = messages.name_of(Status, e["status"])
        values = {
            "valid": e["valid"],
            "contact": e["contact"],
            "contacts": e["contacts"],
            "weights": " ".join(f"{mode['weight']:.4f}" for mode in e["modes"]),
            "ess": e["ess"],
            "particles": e["particles"],
            "injected": e["injected"],
            "proposal": messages.name_of(ProposalKind, e["proposal"]),
            "log_evidence": e["log_evidence"],
        }
    if e and health:
        values |= {
            "age [ms]": f"{e['age_us'] / 1e3:.1f}",
            "overruns": e["overruns"],
            "scans": health["loop"]["scans"],
            "dead taxels": " ".join(map(str, health["dead_taxels"])) or "none",
            "scan to estimate p99 [ms]": f"{health['lat_us']['total']['p99'] / 1e3:.1f}",
        }
    status = {
        "level": level,
        "name": name,
        "message": message,
        "hardware_id": hardware,
        "values": [{"key": key, "value": str(value)} for key, value in values.items()],
    }
    return {"header": header(t, ""), "status": [status]}


def _turned(theta: float) -> Map:
    return {"x": 0.0, "y": 0.0, "z": math.sin(0.5 * theta), "w": math.cos(0.5 * theta)}
