"""The bridge as a process, between a daemon's streams and DDS in this process."""

import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from functools import partial
from itertools import dropwhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.estimator.estimate import Status
from tests.rig.stream_page import documented

pytest.importorskip("cyclonedds")

from rosbags.typesys import Stores, get_typestore

from taxeld_ros2 import cli, dds
from tests.rig import logged as logged_as
from tests.rig.clocks import PATIENCE_S, until
from tests.rig.commands import refused
from tests.rig.configurations import configuration

from .loopback import DOMAIN, ENVIRONMENT, Daemon, Robot, bridge, running

HANGING = """
import pathlib, sys, time
from taxeld_ros2 import dds
reader = dds.reader(dds.participant(), "taxeld/modes", dds.PoseArray, dds.RELIABLE)
while not dds.taken(reader):
    time.sleep(0.01)
pathlib.Path(sys.argv[1]).touch()
time.sleep(600)
"""


class Heard:
    """All messages of the bridge, by topic."""

    def __init__(self, here: Any) -> None:
        self._readers = {
            name: dds.reader(here, name, kind, dds.RELIABLE)
            for name, kind in (
                ("taxeld/pose", dds.SpreadStamped),
                ("taxeld/modes", dds.PoseArray),
                ("diagnostics", dds.Diagnostics),
            )
        }
        self._came: dict[str, list[Any]] = {name: [] for name in self._readers}

    def of(self, topic: str) -> list[Any]:
        self._came[topic] += dds.taken(self._readers[topic])
        return self._came[topic]

    def status(self) -> list[tuple[int, str]]:
        """Level and message of each status of the diagnostics."""
        return [(d.status[0].level, d.status[0].message) for d in self.of("diagnostics")]


@pytest.fixture(scope="module")
def here() -> Any:
    """This process as another ROS node."""
    os.environ |= {name: ENVIRONMENT[name] for name in ("CYCLONEDDS_URI", "ROS_DOMAIN_ID")}
    return dds.participant()


@pytest.fixture
def heard(here: Any) -> Heard:
    return Heard(here)


def seconds(stamp: Any) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def logged(process: Any, part: str) -> str:
    """The first line on standard error that has `part`, without its time and level. A process that
    does not say it is ended."""
    patience = threading.Timer(PATIENCE_S, process.kill)
    patience.start()
    for line in process.stderr:
        if part in line:
            patience.cancel()
            return logged_as.messages(line)[0]
    raise AssertionError(f"{part!r} was not said")


def test_another_process_hears_poses_modes_and_status(daemon: Daemon, heard: Heard) -> None:
    sent: list[dict[str, Any]] = []

    def go_on() -> None:
        sent.append(daemon.say_all())

    with bridge(daemon.endpoint, "--frame", "table") as process:
        until(lambda: len(heard.of("taxeld/pose")) >= 3, go_on)
        until(lambda: any(len(d.status[0].values) > 9 for d in heard.of("diagnostics")), go_on)
        until(lambda: heard.of("taxeld/modes"), go_on)
        assert logged(process, "ready: ") == f"ready: a daemon is heard at {daemon.endpoint}"
    for message in heard.of("taxeld/pose"):
        t, pose = seconds(message.header.stamp), message.pose.pose
        (said,) = (one for one in sent if abs(one["t"] - t) < 1e-6)
        at = pose.position
        assert (at.x, at.y, at.z) == (said["mean"]["x"], said["mean"]["y"], 0.0)
        yaw = 2 * math.atan2(pose.orientation.z, pose.orientation.w)
        assert yaw == pytest.approx(said["mean"]["theta"])
        assert message.header.frame_id == "table"
    assert heard.of("taxeld/modes")[0].poses[0].position.x == daemon.estimate["modes"][0]["x"]
    assert heard.status()[0] == (dds.OK, "converged")


def test_an_estimate_that_may_not_be_used_is_no_pose_and_its_status_is_told(
    daemon: Daemon, heard: Heard
) -> None:
    unusable: list[float] = []

    def tell(**changed: Any) -> None:
        unusable.append(daemon.say(**changed)["t"])

    with bridge(daemon.endpoint):
        until(lambda: heard.of("taxeld/pose"), daemon.say)
        until(
            lambda: (dds.WARN, "inconsistent") in heard.status(),
            partial(tell, valid=False, why=7, status=6),
        )
        told = {one.key: one.value for one in heard.of("diagnostics")[-1].status[0].values}
        assert (told["valid"], told["why"]) == ("False", "inconsistent")
        until(lambda: (dds.OK, "ambiguous") in heard.status(), partial(tell, status=2))
        before = len(heard.of("taxeld/pose"))
        until(lambda: len(heard.of("taxeld/pose")) > before, daemon.say)
    published = [seconds(message.header.stamp) for message in heard.of("taxeld/pose")]
    assert not [t for t in published if np.isclose(t, unusable, rtol=0.0, atol=1e-6).any()]


@pytest.mark.check
def test_without_a_daemon_that_is_said_once_and_told_as_stale_until_one_comes(
    tmp_path: Path, heard: Heard
) -> None:
    endpoint = f"ipc://{tmp_path}/stream"
    with bridge(endpoint) as process:
        line = logged(process, "no daemon")
        assert line == f"no daemon is heard at {endpoint}; is 'taxeld run' there? Waiting"
        until(heard.status)
        assert heard.status()[0] == (dds.STALE, "the daemon is silent")
        daemon = Daemon(tmp_path)
        until(lambda: heard.of("taxeld/pose"), daemon.say)
        line = logged(process, "a daemon is heard")
        assert line == f"ready: a daemon is heard at {endpoint}"
        daemon.close()


def test_a_stream_of_another_version_ends_the_bridge_with_one_line(daemon: Daemon) -> None:
    with bridge(daemon.endpoint) as process:
        until(lambda: process.poll() is not None, lambda: daemon.say(v=1))
        assert process.returncode == 1
        said = process.stderr.read()
    assert said.startswith("/taxeld/estimate: is no message of the stream's version 3, ")
    assert said.count("\n") == 1


def test_the_service_manager_is_told_that_the_bridge_is_ready_alive_and_how_it_is(
    daemon: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE_S)
        monkeypatch.setitem(ENVIRONMENT, "NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setitem(ENVIRONMENT, "WATCHDOG_USEC", "200000")
        with bridge(daemon.endpoint) as process:
            assert manager.recv(1000) == b"READY=1"
            said: list[str] = []

            def listen() -> None:
                daemon.say()
                said.append(manager.recv(1000).decode())

            until(lambda: "WATCHDOG=1" in said, listen)
            until(lambda: said[-1] == "STATUS=a daemon is heard", listen)
            process.terminate()
            until(lambda: manager.recv(1000) == b"STOPPING=1")


@pytest.mark.check
def test_a_reader_that_hangs_costs_the_others_nothing(
    daemon: Daemon, heard: Heard, tmp_path: Path
) -> None:
    """A reliable reader, for whom DDS keeps messages until it has no more room."""
    came = tmp_path / "came"
    with (
        running(sys.executable, "-c", HANGING, str(came)) as hanging,
        bridge(daemon.endpoint),
    ):
        until(came.exists, daemon.say)
        hanging.send_signal(signal.SIGSTOP)
        modes = 200 * daemon.estimate["modes"]  # 11 kB a message
        for _ in range(400):
            last = daemon.say(modes=modes)
            time.sleep(0.002)
        until(lambda: seconds(heard.of("taxeld/pose")[-1].header.stamp) >= last["t"] - 1e-6)


def expecting(robot: Robot, place: Path) -> str:
    """The configuration of a daemon that expects the robot there."""
    return str(configuration(place, sensor_pose={"endpoint": robot.endpoint}))


def test_a_topic_of_poses_becomes_the_robots_poses_and_a_tilted_link_is_left_out(
    here: Any, robot: Robot, tmp_path: Path
) -> None:
    writer = dds.writer(here, "arm/skin", dds.PoseStamped)

    def tell(x: float = 0.0, z: float = 0.0) -> None:
        turn = dds.Quaternion(x, 0.0, z, math.cos(0.15))
        header = dds.header(time.time(), "world")
        writer.write(dds.PoseStamped(header, dds.Pose(dds.Point(2.0, -1.0, 0.5), turn)))

    with bridge(expecting(robot, tmp_path), "--sensor-topic", "/arm/skin") as process:
        pose = until(robot.pose, lambda: tell(z=math.sin(0.15)))
        assert (pose["x"], pose["y"], pose["theta"]) == pytest.approx((2.0, -1.0, 0.3))
        assert 0.0 <= time.time() - pose["t"] < PATIENCE_S
        while robot.pose() is not None:
            pass
        for _ in range(5):
            tell(x=math.sin(0.15))
        line = logged(process, "upright")
        assert line == "no sensor pose: its z axis is over 0.1 rad from upright"
        assert robot.pose() is None
        line = logged(process, "no sensor pose")  # after a while without any
        cure = "look at 'ros2 topic info /arm/skin' and ROS_DOMAIN_ID"
        assert line == f"no sensor pose: no PoseStamped comes on /arm/skin; {cure}"


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["tcp://robot:1"], "endpoint: 'tcp://robot:1' is not local; use"),
        (["ipc:///tmp/x", "--sensor-topic", "/skin"], "sensor_pose.endpoint: is not in CONFIG, so"),
        (["ipc:///tmp/x", "--prefix", "a b"], "--prefix: 'a b' is no name of a ROS 2 topic"),
        (["nowhere.toml"], "nowhere.toml: unreadable configuration"),
    ],
)
def test_settings_that_cannot_be_bridged_are_one_line_that_names_them(
    arguments: list[str], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", ENVIRONMENT["CYCLONEDDS_URI"])
    assert refused(*arguments, main=cli.main).startswith(fault)


def test_a_domain_or_an_endpoint_that_cannot_be_had_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", ENVIRONMENT["CYCLONEDDS_URI"])
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        path = configuration(tmp_path, sensor_pose={"endpoint": endpoint})
        said = refused(path, "--sensor-topic", "/skin", main=cli.main)
    assert said.startswith(f"sensor_pose.endpoint: cannot publish at {endpoint} (Address already")
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    assert refused(path, main=cli.main) == "ROS_DOMAIN_ID: must be 0..232, not '233'\n"


@pytest.mark.parametrize(("sensor", "frame"), [("tcp://127.0.0.1:9874", "world"), ("", "sensor")])
def test_the_frame_is_the_worlds_where_the_daemon_knows_the_skins_pose(
    daemon: Daemon, heard: Heard, tmp_path: Path, sensor: str, frame: str
) -> None:
    with bridge(str(configuration(tmp_path, sensor_pose={"endpoint": sensor}))):
        until(lambda: heard.of("taxeld/pose"), daemon.say)
    assert {one.header.frame_id for one in heard.of("taxeld/pose")} == {frame}


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


SOURCE = Path(__file__).parent / "fastdds_peer.cpp"
HEADERS = ("fastdds/dds/topic/TopicDataType.hpp", "fastcdr/Cdr.h")


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The program, built."""
    compiler = shutil.which("g++")
    if compiler is None or not all((Path("/usr/include") / name).exists() for name in HEADERS):
        pytest.skip("no g++, or not Debian's libfastrtps-dev")
    built = tmp_path_factory.mktemp("peer") / "fastdds_peer"
    how = ("-std=c++17", "-O0", "-Wall", "-Wextra", "-Werror", "-Wno-unused-parameter")
    subprocess.run([compiler, *how, SOURCE, "-o", built, "-lfastrtps", "-lfastcdr"], check=True)
    return str(built)


def test_fast_dds_reads_the_poses_of_the_bridge(peer: str, daemon: Daemon, tmp_path: Path) -> None:
    said = tmp_path / "said"
    with (
        running("sh", "-c", f"exec {peer} hear {DOMAIN} >{said}"),
        bridge(daemon.endpoint, "--frame", "table"),
    ):
        until(lambda: said.exists() and "\n" in said.read_text(), daemon.say)
    _, frame, *numbers = said.read_text().splitlines()[0].split()
    mean, cov = daemon.estimate["mean"], daemon.estimate["cov"]
    expected = [mean["x"], mean["y"], 0.0, mean["theta"], cov[0][0], cov[2][2]]
    assert frame == "table"
    assert [float(n) for n in numbers] == pytest.approx(expected, rel=1e-12)


def test_poses_of_fast_dds_become_the_robots_poses(peer: str, robot: Robot, tmp_path: Path) -> None:
    path = configuration(tmp_path, sensor_pose={"endpoint": robot.endpoint})
    with running(peer, "tell", str(DOMAIN)), bridge(str(path), "--sensor-topic", "/skin"):
        poses = [until(robot.pose) for _ in range(3)]
    for pose in poses:
        assert (pose["x"], pose["y"], pose["theta"]) == pytest.approx((1.0, 0.25, 1.5707963267))
