"""What is exported for ROS 2 is what the replay says, read by another's reader."""

import shutil
from collections.abc import Iterator
from itertools import dropwhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.cli import main
from taxeld.estimator.estimate import Status
from taxeld.stream import messages
from taxeld.view.stage import Stage, recorded
from taxeld.view.streams import Message
from tests.rig.configurations import configuration
from tests.rig.recorded import write_session

from .test_stream_document import documented

pytest.importorskip("mcap_ros2")
pytest.importorskip("rosbags")

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from taxeld.view import export, ros
from tests.rig.commands import refused

RELEASES = [*dropwhile(lambda store: store is not Stores.ROS2_HUMBLE, Stores)]
SESSION = Path(__file__).parent / "session"  # four contacts of a mug
Heard = dict[str, list[Any]]
Said = dict[bytes, list[dict[str, Any]]]


def as_converged(directory: Path, config: Path | None = None) -> tuple[Stage, Iterator[Message]]:
    """A recorded session whose last contact converges."""
    stage, heard = recorded(directory, config)
    last = {"status": int(Status.CONVERGED)}
    return stage, ((topic, m | last if m.get("contacts") == 4 else m) for topic, m in heard)


@pytest.fixture(scope="module")
def said() -> Said:
    """What a replay says, by topic."""
    found: Said = {}
    for topic, message in as_converged(SESSION)[1]:
        found.setdefault(topic, []).append(message)
    return found


@pytest.fixture(scope="module")
def heard(tmp_path_factory: pytest.TempPathFactory) -> Heard:
    """What rosbags reads of the file, by topic."""
    place = tmp_path_factory.mktemp("export")
    shutil.copytree(SESSION, place / "session")
    (place / "session" / "truth.csv").write_text("t,x,y,theta\n1,0.1,0.2,0.5\n", encoding="ascii")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "recorded", as_converged)
        assert main(["export", str(place / "session"), "--mcap", str(place / "run.mcap")]) == 0
    assert [p.name for p in place.iterdir() if p.is_file()] == ["run.mcap"]
    found: Heard = {}
    with AnyReader([place / "run.mcap"]) as reader:
        for connection, t_ns, raw in reader.messages():
            assert connection.msgtype == export.TYPES[connection.topic].replace("/", "/msg/")
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((t_ns, message))
    return found


def yaw(orientation: Any) -> float:
    assert orientation.x == orientation.y == 0.0
    return 2.0 * float(np.arctan2(orientation.z, orientation.w))


def test_poses_are_mean_and_covariance_of_the_estimates_that_may_be_used(
    heard: Heard, said: Said
) -> None:
    valid = [e for e in said[messages.ESTIMATE] if e["valid"]]
    usable = [e for e in valid if e["status"] == Status.CONVERGED]
    assert len(valid) > len(heard["/taxeld/pose"]) == len(usable) > 10
    for (t_ns, message), e in zip(heard["/taxeld/pose"], usable, strict=True):
        stamp = message.header.stamp
        assert t_ns == stamp.sec * 10**9 + stamp.nanosec
        assert t_ns / 1e9 == pytest.approx(e["t"], abs=1e-6)
        assert message.header.frame_id == "world"
        at = message.pose.pose
        assert (at.position.x, at.position.y, at.position.z) == (e["mean"]["x"], e["mean"]["y"], 0)
        assert np.cos(yaw(at.orientation) - e["mean"]["theta"]) == pytest.approx(1.0)
        cov = message.pose.covariance.reshape(6, 6)
        np.testing.assert_array_equal(cov[np.ix_([0, 1, 5], [0, 1, 5])], e["cov"])
        assert np.count_nonzero(cov) <= 9 + 3
        assert (np.diag(cov)[[2, 3, 4]] == 1e6).all(), "height, roll and pitch are not measured"


def test_modes_and_particles_are_arrays_of_poses(heard: Heard, said: Said) -> None:
    valid = [e for e in said[messages.ESTIMATE] if e["valid"]]
    assert max(len(e["modes"]) for e in valid) > 1, "else the session tests little"
    for (_, message), e in zip(heard["/taxeld/modes"], valid, strict=True):
        assert [p.position.x for p in message.poses] == [mode["x"] for mode in e["modes"]]
    clouds = said[messages.PARTICLES]
    for (_, message), cloud in zip(heard["/taxeld/particles"], clouds, strict=True):
        assert [p.position.y for p in message.poses] == [p[1] for p in cloud["xytheta"]]


def test_taxels_are_points_in_a_frame_that_moves_with_the_sensor(heard: Heard, said: Said) -> None:
    position = recorded(SESSION)[0].position_m
    taxels = said[messages.TAXELS]
    assert max(max(one["z"]) for one in taxels) > 0.1
    for (_, cloud), one in zip(heard["/taxeld/taxels"], taxels, strict=True):
        assert cloud.header.frame_id == "taxeld_sensor"
        assert [f.name for f in cloud.fields] == ["x", "y", "z", "intensity", "live"]
        rows = cloud.data.reshape(cloud.width, cloud.point_step)
        values = rows[:, :16].copy().view("<f4")
        np.testing.assert_allclose(values[:, :3], position, atol=1e-7)
        np.testing.assert_allclose(values[:, 3], one["z"], atol=1e-7)
        assert rows[:, cloud.fields[4].offset].astype(bool).tolist() == one["live"]
    placed = [one for one in taxels if one["placed"]]
    assert placed
    for (_, moved), one in zip(heard["/tf"], placed, strict=True):
        (link,) = moved.transforms
        assert (link.header.frame_id, link.child_frame_id) == ("world", "taxeld_sensor")
        assert link.transform.translation.x == one["sensor"]["x"]
        assert yaw(link.transform.rotation) == pytest.approx(one["sensor"]["theta"])


def test_every_estimate_has_a_status_by_its_name(heard: Heard, said: Said) -> None:
    assert len(heard["/taxeld/status"]) == len(said[messages.ESTIMATE])
    names = {message.status[0].message for _, message in heard["/taxeld/status"]}
    assert {"searching", "ambiguous"} <= names
    values = {kv.key: kv.value for kv in heard["/taxeld/status"][-1][1].status[0].values}
    assert values["contacts"] == str(said[messages.ESTIMATE][-1]["contacts"])
    ((_, truth),) = heard["/taxeld/truth"]
    assert (truth.pose.position.x, truth.pose.position.y) == (0.1, 0.2)


@pytest.mark.parametrize("release", RELEASES, ids=lambda release: str(release.name).lower())
def test_definitions_are_those_of_ros_2(release: Stores) -> None:
    """rosbags has those of each release since Humble, and reads ours to the same fields."""
    theirs = get_typestore(release).fielddefs
    for name in ros.TYPES:
        full = name.replace("/", "/msg/")
        ours = get_types_from_msg(ros.definition(name), full)
        assert full in ours
        for one, (_, fields) in ours.items():
            assert fields == theirs[one][1]


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


def test_a_session_without_a_whole_scan_is_one_line_and_leaves_no_file(tmp_path: Path) -> None:
    write_session(tmp_path, touches=0)
    lines = (tmp_path / "frames.log").read_text(encoding="ascii").splitlines(keepends=True)
    (tmp_path / "frames.log").write_text("".join(lines[:5]), encoding="ascii")
    configuration(tmp_path)
    out = tmp_path / "run.mcap"
    assert "nothing to export" in refused("export", tmp_path, "--mcap", out)
    assert not list(tmp_path.glob("run.mcap*"))


@pytest.mark.parametrize(
    ("session", "file", "text"),
    [
        ("{place}", "x.mcap", "{place}: is no session"),
        (SESSION, "no/x.mcap", "--mcap: cannot write"),
    ],
    ids=["no session", "no directory"],
)
def test_what_is_no_session_and_what_cannot_be_written_is_one_line(
    tmp_path: Path, session: object, file: str, text: str
) -> None:
    arguments = [str(session).format(place=tmp_path), "--mcap", str(tmp_path / file)]
    assert refused("export", *arguments).startswith(text.format(place=tmp_path))
