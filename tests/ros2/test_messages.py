"""The daemon's maps as ROS 2 messages, and as the bytes that DDS sends."""

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from taxeld.estimator.estimate import Status

from ..daemon.test_stream_document import documented

pytest.importorskip("cyclonedds")

from cyclonedds.core import DDSException
from cyclonedds.idl.types import sequence, uint32

from taxeld_ros2 import cdr, convert, dds, markers
from taxeld_ros2 import ros_types as ros

OUTLINE = np.array([[0.1, 0.0], [0.0, 0.2], [-0.1, 0.0]])


@pytest.fixture
def estimate() -> dict[str, Any]:
    return {
        **documented("/taxeld/estimate")[1],
        "modes": [
            {"x": 1.0, "y": 2.0, "theta": math.pi / 2, "weight": 0.75},
            {"x": 0.5, "y": -2.0, "theta": 0.0, "weight": 0.05},
        ],
    }


def pose_of(estimate: dict[str, Any], frame: str = "world") -> ros.PoseWithCovarianceStamped:
    """As a reader has it."""
    sent = convert.pose_with_covariance(estimate, frame, 0.3).serialize()
    return ros.PoseWithCovarianceStamped.deserialize(sent)


def modes_of(estimate: dict[str, Any], frame: str = "world") -> ros.PoseArray:
    return ros.PoseArray.deserialize(convert.modes(estimate, frame, 0.3).serialize())


def test_the_covariance_stands_where_ros_has_x_y_and_yaw(estimate: dict[str, Any]) -> None:
    message = pose_of(estimate)
    found = np.array(message.pose.covariance).reshape(6, 6)
    assert np.array_equal(found[np.ix_([0, 1, 5], [0, 1, 5])], np.array(estimate["cov"]))
    assert np.count_nonzero(found) == 9
    assert message.pose.pose.position.z == 0.3


def test_the_pose_is_the_mean_that_the_covariance_is_about(estimate: dict[str, Any]) -> None:
    pose = pose_of(estimate).pose.pose
    assert pose.position.x == estimate["mean"]["x"]
    assert 2 * math.atan2(pose.orientation.z, pose.orientation.w) == pytest.approx(
        estimate["mean"]["theta"]
    )


@pytest.mark.parametrize("t", [1700000005.121, 1.9999999999, 0.0, 1795357978.776642])
def test_a_stamp_is_the_measurements_time_and_its_nanoseconds_are_less_than_a_second(
    t: float,
) -> None:
    stamp = convert.time_of(t)
    assert pose_of({**documented("/taxeld/estimate")[1], "t": t}).header.stamp == stamp
    assert 0 <= stamp.nanosec < 1_000_000_000
    assert stamp.sec + stamp.nanosec * 1e-9 == pytest.approx(t, abs=1e-6)


def test_modes_are_all_there_the_heaviest_first(estimate: dict[str, Any]) -> None:
    poses = modes_of(estimate).poses
    assert [pose.position.x for pose in poses] == [1.0, 0.5]


@pytest.mark.parametrize("status", list(Status))
def test_every_status_has_a_level_and_its_name(estimate: dict[str, Any], status: Status) -> None:
    health = documented("/taxeld/health")[1]
    told = convert.diagnostics({**estimate, "status": int(status)}, health, 5.0, "taxeld")
    (one,) = told.status
    assert one.message == status.name.lower()
    assert (one.level == convert.OK) == (
        status in {Status.SEARCHING, Status.AMBIGUOUS, Status.CONVERGED}
    )
    assert {value.key: value.value for value in one.values}["dead taxels"] == "4 17 30"


def test_a_status_of_a_later_daemon_is_told_by_its_number(estimate: dict[str, Any]) -> None:
    (one,) = convert.diagnostics({**estimate, "status": 99}, {}, 5.0, "taxeld").status
    assert (one.level, one.message) == (convert.WARN, "status 99")


def test_a_daemon_that_is_not_heard_is_stale() -> None:
    (one,) = convert.diagnostics({}, {}, 5.0, "taxeld").status
    assert (one.level, one.message) == (convert.STALE, convert.SILENT)


@pytest.mark.parametrize("frame", ["", "a", "abc", "world", "größe"])
def test_poses_and_modes_are_the_bytes_that_cyclonedds_itself_would_write(
    estimate: dict[str, Any], frame: str
) -> None:
    pose, poses = pose_of(estimate, frame), modes_of(estimate, frame)
    assert pose.header.frame_id == poses.header.frame_id == frame
    assert (
        pose.serialize(use_version_2=False)
        == convert.pose_with_covariance(estimate, frame, 0.3).serialize()
    )
    assert poses.serialize(use_version_2=False) == convert.modes(estimate, frame, 0.3).serialize()


@pytest.mark.parametrize("frame", ["", "a", "abc", "world"])
@pytest.mark.parametrize("particles", [0, 1, 3])
def test_markers_are_the_bytes_that_cyclonedds_itself_would_write(
    estimate: dict[str, Any], frame: str, particles: int
) -> None:
    rng = np.random.default_rng(particles)
    cloud = {"xytheta": rng.normal(size=(particles, 3)).tolist(), "weight": [1.0] * particles}
    drawn = markers.markers(estimate, cloud if particles else {}, OUTLINE, frame, 0.1)
    written = drawn.serialize()
    read = ros.MarkerArray.deserialize(written)
    assert ros.MarkerArray.serialize(read, use_version_2=False) == written
    assert all(marker.header.frame_id == frame for marker in read.markers)
    assert [m.action for m in read.markers][:5] == [0, 0, 2, 2, 2], "what is no more is taken away"
    assert [len(m.points) for m in read.markers] == [4, 4, 0, 0, 0, particles]


@dataclass
class Uneven(ros.IdlStruct, typename="test::Uneven"):
    """Whose points do not follow a multiple of eight bytes by themselves."""

    a: uint32
    b: bool
    points: sequence[ros.Point]


@pytest.mark.parametrize("points", [0, 1, 2])
def test_points_stand_at_multiples_of_their_size(points: int) -> None:
    writer = cdr.Writer()
    writer.uint32(7)
    writer.boolean(True)
    writer.points(np.full((points, 3), 1.5))
    expected = Uneven(7, True, [ros.Point(1.5, 1.5, 1.5)] * points)
    assert writer.done() == expected.serialize(use_version_2=False)


def test_a_message_that_dds_does_not_take_is_counted_and_said_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    class Full:
        def write(self, _: object) -> None:
            raise DDSException(DDSException.DDS_RETCODE_TIMEOUT, "no room")

    output = dds.Output("taxeld/pose", Full())
    for _ in range(3):
        output.write("message")
    assert output.lost == 3
    (line,) = [record.message for record in caplog.records]
    assert line.startswith("/taxeld/pose: 1 messages were lost (")


def test_a_mode_is_drawn_where_it_is_and_as_strongly_as_it_weighs(estimate: dict[str, Any]) -> None:
    first, second, *_ = ros.MarkerArray.deserialize(
        markers.markers(estimate, {}, OUTLINE, "world", 0.1).serialize()
    ).markers
    at = [(p.x, p.y, p.z) for p in first.points]
    assert at[0] == at[-1] == pytest.approx((1.0, 2.1, 0.1))
    assert at[1] == pytest.approx((0.8, 2.0, 0.1))
    assert first.color.a == pytest.approx(0.75)
    assert second.color.a == pytest.approx(markers.FAINTEST)


def test_nothing_is_drawn_of_an_estimate_that_is_not_valid(estimate: dict[str, Any]) -> None:
    cloud = {"xytheta": [[0.0, 0.0, 0.0]], "weight": [1.0]}
    drawn = markers.markers({**estimate, "valid": False}, cloud, OUTLINE, "world", 0.0)
    assert all(
        m.action == markers.DELETE for m in ros.MarkerArray.deserialize(drawn.serialize()).markers
    )


def test_every_type_is_named_as_ros_names_it() -> None:
    kinds = [k for k in vars(ros).values() if isinstance(k, type) and issubclass(k, ros.IdlStruct)]
    named = [k for k in kinds if k is not ros.IdlStruct]
    assert len(named) > 20
    for kind in named:
        package, _, name = dds.ros_type(kind).split("/")
        assert name == kind.__name__
        assert re.fullmatch(r"\w+::msg::dds_::\w+_", kind.__idl_typename__.replace(".", "::"))
        assert package.endswith(("_msgs", "_interfaces"))
