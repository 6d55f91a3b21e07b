"""ROS 2 messages as DDS sends them."""

import math
from typing import Any

import numpy as np
import pytest

from ..daemon.test_stream_document import documented

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from cyclonedds.core import DDSException
from rosbags.typesys import Stores, get_typestore

from taxeld.estimator.estimate import Status
from taxeld.view import ros
from taxeld_ros2 import dds
from taxeld_ros2.markers import ADD, DELETE, FAINTEST, markers

OUTLINE = np.array([[0.1, 0.0], [0.0, 0.2], [-0.1, 0.0]])
PLAIN = {"string": "größe", "bool": True, "float32": 1.5, "float64": 1.5}


@pytest.fixture
def estimate() -> dict[str, Any]:
    modes = [
        {"x": 1.0, "y": 2.0, "theta": math.pi / 2, "weight": 0.75, "object": 0},
        {"x": 0.5, "y": -2.0, "theta": 0.0, "weight": 0.05, "object": 0},
    ]
    return {**documented("/taxeld/estimate")[1], "modes": modes}


def filled(kind: str) -> Any:
    """A value of which no field, nor any sequence, is empty."""
    base, is_many, length = kind.rstrip("]").partition("[")
    if is_many:
        return [filled(base)] * int(length or 3)
    if "/" in base:
        return {field: filled(one) for one, field in ros.fields(base)}
    return PLAIN.get(base, 7)


@pytest.mark.parametrize("name", ros.TYPES)
def test_ros_reads_the_bytes_of_each_type(name: str) -> None:
    """rosbags has ROS 2's own definitions."""
    written = dds.message(name, filled(name)).serialize(use_version_2=False)
    store, full = get_typestore(Stores.ROS2_HUMBLE), name.replace("/", "/msg/")
    read = store.deserialize_cdr(written, full)
    assert bytes(store.serialize_cdr(read, full)) == written


def test_fields_that_are_left_out_are_zero_or_empty() -> None:
    made = dds.message("visualization_msgs/Marker", {"ns": "modes"})
    assert (made.ns, made.id, made.text, made.frame_locked, made.points) == (
        "modes",
        0,
        "",
        False,
        [],
    )
    assert made.texture.header.stamp.sec == 0


def test_a_mode_is_drawn_where_it_is_as_strongly_as_it_weighs_if_it_is_valid(
    estimate: dict[str, Any],
) -> None:
    cloud = {"xytheta": [[0.0, 0.0, 0.0]] * 3}
    *modes, particles = markers(estimate, cloud, [OUTLINE], "world", 0.1)["markers"]
    at = [(p["x"], p["y"], p["z"]) for p in modes[0]["points"]]
    assert at[0] == at[-1] == pytest.approx((1.0, 2.1, 0.1))
    assert at[1] == pytest.approx((0.8, 2.0, 0.1))
    assert [m["color"]["a"] for m in modes[:2]] == [0.75, FAINTEST]
    assert [m["action"] for m in modes] == [ADD, ADD, DELETE, DELETE, DELETE]
    assert len(particles["points"]) == 3
    drawn = markers({**estimate, "valid": False}, cloud, [OUTLINE], "world", 0.0)["markers"]
    assert {m["action"] for m in drawn} == {DELETE}


def test_a_message_that_dds_does_not_take_is_counted_and_said_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    class Full:
        def write(self, _: object) -> None:
            raise DDSException(DDSException.DDS_RETCODE_TIMEOUT, "no room")

    output = dds.Output("taxeld/pose", "geometry_msgs/PoseArray", Full())
    for _ in range(3):
        output.write({})
    assert output.lost == 3
    (line,) = [record.message for record in caplog.records]
    assert line.startswith("/taxeld/pose: 1 messages were lost (")


@pytest.mark.parametrize("status", [*Status, 99], ids=str)
def test_every_status_has_a_level_and_its_name(status: int) -> None:
    estimate = {**documented("/taxeld/estimate")[1], "status": int(status)}
    health = documented("/taxeld/health")[1]
    (told,) = ros.diagnostics(5.0, "taxeld", estimate, health)["status"]
    assert told["message"] == getattr(status, "name", "unknown (99)").lower()
    good = {Status.SEARCHING, Status.AMBIGUOUS, Status.CONVERGED}
    assert (told["level"] == ros.OK) == (status in good)
    values = {kv["key"]: kv["value"] for kv in told["values"]}
    assert values["dead taxels"] == "4 17 30"
    assert (values["p"], values["radius_m"], values["moved"]) == ("0.996", "0.0088", "0.0015")


@pytest.mark.parametrize("t", [1700000005.121, 1.9999999999, 0.0, 1795357978.776642])
def test_a_stamp_is_the_measurements_time_and_its_nanoseconds_are_less_than_a_second(
    t: float,
) -> None:
    stamp = ros.header(t)["stamp"]
    assert 0 <= stamp["nanosec"] < 1_000_000_000
    assert stamp["sec"] + stamp["nanosec"] * 1e-9 == pytest.approx(t, abs=1e-6)
