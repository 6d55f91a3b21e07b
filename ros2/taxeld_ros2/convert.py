"""The daemon's maps as ROS 2 messages."""

import math
from typing import Any

from taxeld.estimator.estimate import Status
from taxeld_ros2.cdr import Writer, Written
from taxeld_ros2.ros_types import (
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    KeyValue,
    PoseArray,
    PoseWithCovarianceStamped,
    Time,
)

OK, WARN, STALE = 0, 1, 3  # levels of a DiagnosticStatus
LEVELS = {
    Status.STARTING: WARN,
    Status.SEARCHING: OK,
    Status.AMBIGUOUS: OK,
    Status.CONVERGED: OK,
    Status.BLIND: WARN,
    Status.STALE: STALE,
    Status.INCONSISTENT: WARN,
}
PLANAR = (0, 1, 5)  # x, y and yaw in the 6 × 6 of x, y, z and the turns about them
SILENT = "the daemon is silent"


def time_of(t: float) -> Time:
    """Of Unix seconds."""
    ns = round(t * 1e9)
    return Time(ns // 1_000_000_000, ns % 1_000_000_000)


def header(t: float, frame: str) -> Header:
    return Header(time_of(t), frame)


class PoseMessage(Written, PoseWithCovarianceStamped):
    """Ready to be sent."""


class ModesMessage(Written, PoseArray):
    """Ready to be sent."""


def pose_with_covariance(estimate: dict[str, Any], frame: str, z_m: float) -> PoseMessage:
    """The mean, and the covariance about it; 0 of height, roll and pitch, which the object has
    not."""
    covariance = [0.0] * 36
    for row, k in zip(estimate["cov"], PLANAR, strict=True):
        for value, other in zip(row, PLANAR, strict=True):
            covariance[6 * k + other] = value
    writer = Writer()
    writer.header(estimate["t"], frame)
    writer.float64(*_fields(estimate["mean"], z_m), *covariance)
    return PoseMessage(writer.done())


def modes(estimate: dict[str, Any], frame: str, z_m: float) -> ModesMessage:
    """The heaviest first."""
    writer = Writer()
    writer.header(estimate["t"], frame)
    writer.uint32(len(estimate["modes"]))
    for mode in estimate["modes"]:
        writer.float64(*_fields(mode, z_m))
    return ModesMessage(writer.done())


def _fields(pose: dict[str, float], z_m: float) -> tuple[float, ...]:
    """Of a `geometry_msgs/msg/Pose`: position, and the quaternion of a turn about z."""
    half = 0.5 * pose["theta"]
    return pose["x"], pose["y"], z_m, 0.0, 0.0, math.sin(half), math.cos(half)


def diagnostics(
    estimate: dict[str, Any], health: dict[str, Any], now: float, name: str
) -> DiagnosticArray:
    """What the estimate is worth, with what a technician asks first; `estimate` is empty where no
    daemon is heard. `now`: Unix seconds."""
    if not estimate:
        status = DiagnosticStatus(STALE, name, SILENT, "", [])
        return DiagnosticArray(header(now, ""), [status])
    level, told = _judged(estimate["status"])
    shown = {
        "status": told,
        "valid": str(estimate["valid"]).lower(),
        "contacts": str(estimate["contacts"]),
        "modes": str(len(estimate["modes"])),
        "heaviest mode": f"{estimate['modes'][0]['weight']:.2f}",
        "age [ms]": f"{estimate['age_us'] / 1e3:.1f}",
        "overruns": str(estimate["overruns"]),
    }
    if health:
        shown["scans"] = str(health["loop"]["scans"])
        shown["dead taxels"] = " ".join(map(str, health["dead_taxels"])) or "none"
        shown["scan to estimate p99 [ms]"] = f"{health['lat_us']['total']['p99'] / 1e3:.1f}"
    values = [KeyValue(key, value) for key, value in shown.items()]
    status = DiagnosticStatus(level, name, told, "", values)
    return DiagnosticArray(header(now, ""), [status])


def _judged(status: int) -> tuple[int, str]:
    """Level and name; a later daemon may know more of them than this bridge."""
    if status not in LEVELS:
        return WARN, f"status {status}"
    known = Status(status)
    return LEVELS[known], known.name.lower()
