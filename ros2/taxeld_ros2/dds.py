"""ROS 2 by DDS: its messages, what they say of a daemon, and topics as its nodes have them."""

import contextlib
import math
import os
from typing import Any

import numpy as np
from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, byte, float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld.pipeline.freshness import Why
from taxeld.stream.messages import name_of, object_of

DOMAIN_MAX = 232  # higher domains have no ports
KEPT, TAKEN = 10, 200  # messages kept for a reader, as ROS 2's own publishers do; taken at once
BLOCKED_MS = 1  # a reliable reader that does not keep up holds a writer no longer
CDR = Policy.DataRepresentation(use_cdrv0_representation=True)  # as ROS 2 writes and reads
RELIABLE = Policy.Reliability.Reliable(duration(milliseconds=BLOCKED_MS))
BEST_EFFORT = Policy.Reliability.BestEffort
OK, WARN, STALE = 0, 1, 3  # levels of a diagnostic_msgs/DiagnosticStatus
GOOD = Status.SEARCHING, Status.AMBIGUOUS, Status.CONVERGED
SAID = "valid p radius_m contact contacts particles ess age_us"  # an estimate's keys
UNKNOWN = 1e6  # variance of what is not measured, as robot_localization has it


def _type(kind: str, /, **fields: Any) -> Any:
    package, name = kind.split("/")
    return make_idl_struct(name, f"{package}::msg::dds_::{name}_", fields)


# Fields as the `.msg` files of Humble and later have them, in the order of the wire
F = float64
Time = _type("builtin_interfaces/Time", sec=int32, nanosec=uint32)
Header = _type("std_msgs/Header", stamp=Time, frame_id=str)
Point = _type("geometry_msgs/Point", x=F, y=F, z=F)
Quaternion = _type("geometry_msgs/Quaternion", x=F, y=F, z=F, w=F)
Pose = _type("geometry_msgs/Pose", position=Point, orientation=Quaternion)
PoseStamped = _type("geometry_msgs/PoseStamped", header=Header, pose=Pose)
PoseArray = _type("geometry_msgs/PoseArray", header=Header, poses=sequence[Pose])
Spread = _type("geometry_msgs/PoseWithCovariance", pose=Pose, covariance=array[F, 36])
SpreadStamped = _type("geometry_msgs/PoseWithCovarianceStamped", header=Header, pose=Spread)
KeyValue = _type("diagnostic_msgs/KeyValue", key=str, value=str)
words = dict.fromkeys(("name", "message", "hardware_id"), str)
Told = _type("diagnostic_msgs/DiagnosticStatus", level=byte, **words, values=sequence[KeyValue])
Diagnostics = _type("diagnostic_msgs/DiagnosticArray", header=Header, status=sequence[Told])


def header(t: float, frame: str) -> Any:
    ns = round(t * 1e9)
    return Header(Time(ns // 10**9, ns % 10**9), frame)


def pose(planar: dict[str, Any]) -> Any:
    """Of `x`, `y`, `theta`."""
    half = 0.5 * planar["theta"]
    turn = Quaternion(0.0, 0.0, math.sin(half), math.cos(half))
    return Pose(Point(planar["x"], planar["y"], 0.0), turn)


def pose_with_covariance(e: dict[str, Any], frame: str) -> Any:
    """Mean and covariance of `/taxeld/estimate`; height, roll and pitch are not known."""
    cov, known = np.diag(np.full(6, UNKNOWN)), [0, 1, 5]  # of x, y, z, roll, pitch, yaw
    cov[np.ix_(known, known)] = e["cov"]
    return SpreadStamped(header(e["t"], frame), Spread(pose(e["mean"]), cov.ravel().tolist()))


def diagnostics(t: float, name: str, e: dict[str, Any], health: dict[str, Any]) -> Any:
    """Of `/taxeld/estimate`, empty where no daemon is heard, and of `/taxeld/health`, or empty."""
    level, message, values = STALE, "the daemon is silent", {}
    if e:
        message = name_of(Status, e["status"])
        level = OK if e["status"] in GOOD else STALE if e["status"] == Status.STALE else WARN
        values = {key: e[key] for key in SAID.split()} | e["hypotheses"]
        values |= {"why": name_of(Why, e["why"]), "object": object_of(e)}
        values["dead_taxels"] = " ".join(map(str, health.get("dead_taxels", ())))
    pairs = [KeyValue(key, str(value)) for key, value in values.items()]
    return Diagnostics(header(t, ""), [Told(level, name, message, "", pairs)])


def participant() -> Any:
    """Of the domain that ROS_DOMAIN_ID names, or of 0. Raises SetupError: it cannot be had."""
    text = os.environ.get("ROS_DOMAIN_ID", "0")
    if not text.isascii() or not text.isdigit() or int(text) > DOMAIN_MAX:
        raise SetupError(f"ROS_DOMAIN_ID: must be 0..{DOMAIN_MAX}, not {text!r}")
    try:
        return DomainParticipant(int(text))
    except DDSException as error:
        fault = f"DDS cannot be had in domain {text} ({error.msg.strip()})"
        raise SetupError(f"{fault}; look at CYCLONEDDS_URI and the network") from None


def writer(of: Any, name: str, kind: Any) -> Any:
    """A participant's writer of the ROS topic `/name`."""
    qos = Qos(CDR, Policy.History.KeepLast(KEPT), RELIABLE)
    return DataWriter(of, Topic(of, f"rt/{name.strip('/')}", kind), qos=qos)


def reader(of: Any, name: str, kind: Any, reliability: Any = BEST_EFFORT) -> Any:
    qos = Qos(CDR, Policy.History.KeepLast(TAKEN), reliability)
    return DataReader(of, Topic(of, f"rt/{name.strip('/')}", kind), qos=qos)


def write(to: Any, message: Any) -> None:
    """Send a message: a reader that does not keep up loses it, and holds nobody up."""
    with contextlib.suppress(DDSException):
        to.write(message)


def taken(reader: Any) -> list[Any]:
    """The messages that have come, without what DDS tells of writers that have gone."""
    return [sample for sample in reader.take(N=TAKEN) if sample.sample_info.valid_data]
