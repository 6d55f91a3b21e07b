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
from taxeld.pipeline.freshness import Why
from taxeld.stream.messages import name_of, object_of

Map = dict[str, Any]

WORLD, SENSOR = "world", "taxeld_sensor"  # frames of the robot's poses and of the skin
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
IN_6X6 = [0, 1, 5]  # places of x, y and yaw among x, y, z, roll, pitch, yaw
UNKNOWN = 1e6  # variance of the others, which are not measured, as robot_localization has it
RULE = "=" * 80  # parts of a definition stand between such lines (mcap.dev/spec/registry)

# Fields as the `.msg` files of Humble and later have them, in the order of the wire
TYPES = {
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec, uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "std_msgs/ColorRGBA": "float32 r, float32 g, float32 b, float32 a",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "geometry_msgs/PoseArray": "std_msgs/Header header, geometry_msgs/Pose[] poses",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose, float64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": (
        "std_msgs/Header header, geometry_msgs/PoseWithCovariance pose"
    ),
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "diagnostic_msgs/KeyValue": "string key, string value",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte level, string name, string message, string hardware_id, "
        "diagnostic_msgs/KeyValue[] values"
    ),
    "diagnostic_msgs/DiagnosticArray": (
        "std_msgs/Header header, diagnostic_msgs/DiagnosticStatus[] status"
    ),
    "sensor_msgs/PointField": "string name, uint32 offset, uint8 datatype, uint32 count",
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header, uint32 height, uint32 width, sensor_msgs/PointField[] fields, "
        "bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, bool is_dense"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header, string format, uint8[] data",
    "visualization_msgs/UVCoordinate": "float32 u, float32 v",
    "visualization_msgs/MeshFile": "string filename, uint8[] data",
    "visualization_msgs/Marker": (
        "std_msgs/Header header, string ns, int32 id, int32 type, int32 action, "
        "geometry_msgs/Pose pose, geometry_msgs/Vector3 scale, std_msgs/ColorRGBA color, "
        "builtin_interfaces/Duration lifetime, bool frame_locked, geometry_msgs/Point[] points, "
        "std_msgs/ColorRGBA[] colors, string texture_resource, "
        "sensor_msgs/CompressedImage texture, visualization_msgs/UVCoordinate[] uv_coordinates, "
        "string text, string mesh_resource, visualization_msgs/MeshFile mesh_file, "
        "bool mesh_use_embedded_materials"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
}


def fields(name: str) -> list[tuple[str, str]]:
    """Type and name of each field of `package/Type`, in the order of the wire."""
    pairs = (field.split(" ") for field in TYPES[name].split(", "))
    return [(kind, field) for kind, field in pairs]


def definition(name: str) -> str:
    """The text of `package/Type` and of all types that it refers to, as an MCAP file has it."""
    needed = [name]
    for one in needed:
        kinds = (kind.partition("[")[0] for kind, _ in fields(one))
        needed += [kind for kind in kinds if kind in TYPES and kind not in needed]
    first, *others = (f"MSG: {one}\n" + TYPES[one].replace(", ", "\n") for one in needed)
    return f"\n{RULE}\n".join([first.partition("\n")[2], *others])


def header(t: float, frame: str = WORLD) -> Map:
    ns = round(t * 1e9)
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": frame}


def pose(planar: Map, z_m: float = 0.0) -> Map:
    """A `geometry_msgs/Pose` of `x`, `y`, `theta`."""
    half = 0.5 * planar["theta"]
    return {
        "position": {"x": planar["x"], "y": planar["y"], "z": z_m},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)},
    }


def is_usable(e: Map) -> bool:
    """Whether the pose of `/taxeld/estimate` may be used (docs/stream.md)."""
    return bool(e["valid"]) and e["status"] == Status.CONVERGED


def pose_with_covariance(e: Map, frame: str = WORLD, z_m: float = 0.0) -> Map:
    """Mean and covariance of `/taxeld/estimate`; height, roll and pitch are not known."""
    cov = np.diag(np.full(6, UNKNOWN))
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
    at = pose(taxels["sensor"])
    moved = {"translation": at["position"], "rotation": at["orientation"]}
    one = {"header": header(taxels["t"]), "child_frame_id": SENSOR, "transform": moved}
    return {"transforms": [one]}


def point_cloud(taxels: Map, position_m: Floats) -> Map:
    """The taxels at `position_m` (M, 3), with their activation as intensity, and which live."""
    points = np.zeros(len(position_m), POINT)
    points["x"], points["y"], points["z"] = position_m.T
    points["intensity"], points["live"] = taxels["z"], taxels["live"]
    kinds = {"live": UINT8}
    return {
        "header": header(taxels["t"], SENSOR),
        "height": 1,
        "width": len(points),
        "fields": [
            {"name": name, "offset": field[1], "datatype": kinds.get(name, FLOAT32), "count": 1}
            for name, field in (POINT.fields or {}).items()
        ],
        "is_bigendian": False,
        "point_step": POINT.itemsize,
        "row_step": points.nbytes,
        "data": points.tobytes(),
        "is_dense": True,
    }


def diagnostics(t: float, name: str, e: Map, health: Map | None = None, hardware: str = "") -> Map:
    """The status of an estimate, and its values that have no place in a pose; `e` is empty where no
    daemon is heard. `health` adds times and faults."""
    level, message, values = STALE, SILENT, {}
    if e:
        level = LEVELS.get(e["status"], WARN)
        message = name_of(Status, e["status"])
        values = {
            "valid": e["valid"],
            "why": name_of(Why, e["why"]),
            "p": e["p"],
            "radius_m": e["radius_m"],
            **e["hypotheses"],
            "object": object_of(e),
            "contact": e["contact"],
            "contacts": e["contacts"],
            "weights": " ".join(f"{mode['weight']:.4f}" for mode in e["modes"]),
            "ess": e["ess"],
            "particles": e["particles"],
            "injected": e["injected"],
            "proposal": name_of(ProposalKind, e["proposal"]),
            "log_evidence": e["log_evidence"],
        }
    if e and health:
        values |= {
            "age [ms]": f"{e['age_us'] / 1e3:.1f}",
            "overruns": e["overruns"],
            "scans": health["source"]["scans"],
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
