"""ROS 2's messages as DDS sends them, and what they say of an estimate."""

from itertools import dropwhile

import numpy as np
import pytest

from taxeld.estimator.estimate import Status
from tests.rig.stream_page import documented

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from rosbags.typesys import Stores, get_typestore

from taxeld_ros2 import dds

T = 1795357978.776642
ESTIMATE, HEALTH = (documented(f"/taxeld/{name}")[1] for name in ("estimate", "health"))
POSE = dds.pose({"x": 1.0, "y": 2.0, "theta": 0.6})
MADE = {
    "geometry_msgs/msg/PoseStamped": dds.PoseStamped(dds.header(T, "größe"), POSE),
    "geometry_msgs/msg/PoseArray": dds.PoseArray(dds.header(T, "world"), [POSE] * 3),
    "geometry_msgs/msg/PoseWithCovarianceStamped": dds.pose_with_covariance(ESTIMATE, "world"),
    "diagnostic_msgs/msg/DiagnosticArray": dds.diagnostics(T, "taxeld", ESTIMATE, HEALTH),
}


@pytest.mark.parametrize("name", MADE)
def test_ros_reads_the_bytes_of_each_message(name: str) -> None:
    """rosbags has ROS 2's own definitions, of each release since Humble."""
    written = MADE[name].serialize(use_version_2=False)
    for release in dropwhile(lambda one: one is not Stores.ROS2_HUMBLE, Stores):
        store = get_typestore(release)
        read = store.deserialize_cdr(written, name)
        assert bytes(store.serialize_cdr(read, name)) == written
    assert MADE[name].__idl_typename__ == name.replace("/msg/", "::msg::dds_::") + "_"


def test_a_pose_is_the_mean_and_what_is_not_measured_has_a_great_variance() -> None:
    made = dds.pose_with_covariance(ESTIMATE, "world")
    cov = np.reshape(made.pose.covariance, (6, 6))
    np.testing.assert_array_equal(cov[np.ix_([0, 1, 5], [0, 1, 5])], ESTIMATE["cov"])
    assert (np.diag(cov)[[2, 3, 4]] == 1e6).all()
    assert made.pose.pose.position.x == ESTIMATE["mean"]["x"]
    stamp = dds.header(1.9999999999, "world").stamp
    assert (stamp.sec, stamp.nanosec) == (2, 0), "less than a second of nanoseconds"


@pytest.mark.parametrize("status", [*Status, 99], ids=str)
def test_every_status_has_a_level_and_its_name(status: int) -> None:
    (told,) = dds.diagnostics(T, "taxeld", ESTIMATE | {"status": int(status)}, HEALTH).status
    assert told.message == getattr(status, "name", "unknown (99)").lower()
    good = {Status.SEARCHING, Status.AMBIGUOUS, Status.CONVERGED}
    assert (told.level == dds.OK) == (status in good)
    values = {one.key: one.value for one in told.values}
    assert values["dead_taxels"] == "4 17 30"
    assert (values["p"], values["radius_m"], values["moved"]) == ("0.996", "0.0088", "0.0015")
