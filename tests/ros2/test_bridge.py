"""The bridge as a process, between a daemon's streams and DDS in this process."""

import math
import os
import re
import signal
import socket
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from taxeld.view import ros
from taxeld_ros2 import cli
from taxeld_ros2.dds import LATCHED, RELIABLE, Participant, taken
from tests.rig import logged as logged_as
from tests.rig.clocks import PATIENCE_S, until
from tests.rig.commands import refused
from tests.rig.configurations import configuration

from .loopback import DOMAIN, ENVIRONMENT, Daemon, Robot, bridge, running

HANGING = """
import pathlib, sys, threading
from taxeld_ros2.dds import RELIABLE, Participant
came = threading.Event()
kind = "geometry_msgs/PoseArray"
reader = Participant().reader("taxeld/modes", kind, came.set, RELIABLE)
came.wait()
pathlib.Path(sys.argv[1]).touch()
came.clear()
came.wait(600)
"""

SERVED = (
    "ready: a daemon is heard at {}; published are /taxeld/pose, /taxeld/modes, /taxeld/markers "
    "and /diagnostics"
)


class Heard:
    """All messages of the bridge, by topic."""

    def __init__(self, dds: Participant) -> None:
        self._readers = {
            name: dds.reader(name, kind, lambda: None, RELIABLE)
            for name, kind in (
                ("taxeld/pose", "geometry_msgs/PoseWithCovarianceStamped"),
                ("taxeld/modes", "geometry_msgs/PoseArray"),
                ("taxeld/markers", "visualization_msgs/MarkerArray"),
                ("diagnostics", "diagnostic_msgs/DiagnosticArray"),
            )
        }
        self._came: dict[str, list[Any]] = {name: [] for name in self._readers}

    def of(self, topic: str) -> list[Any]:
        self._came[topic] += taken(self._readers[topic])
        return self._came[topic]

    def status(self) -> list[tuple[int, str]]:
        """Level and message of each status of the diagnostics."""
        return [(d.status[0].level, d.status[0].message) for d in self.of("diagnostics")]


@pytest.fixture(scope="module")
def here() -> Participant:
    """This process as another ROS node."""
    os.environ |= {name: ENVIRONMENT[name] for name in ("CYCLONEDDS_URI", "ROS_DOMAIN_ID")}
    return Participant()


@pytest.fixture
def heard(here: Participant) -> Heard:
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


def test_another_process_hears_poses_modes_markers_and_status(daemon: Daemon, heard: Heard) -> None:
    sent: list[dict[str, Any]] = []

    def go_on() -> None:
        sent.append(daemon.say_all())

    with bridge("--stream", daemon.endpoint, "--frame", "table", "--z-m", "0.2") as process:
        until(lambda: len(heard.of("taxeld/pose")) >= 3, go_on)
        until(lambda: any(m.markers[5].points for m in heard.of("taxeld/markers")), go_on)
        until(lambda: any(len(d.status[0].values) > 9 for d in heard.of("diagnostics")), go_on)
        until(lambda: heard.of("taxeld/modes"), go_on)
        assert logged(process, "ready: ") == SERVED.format(daemon.endpoint)
    for message in heard.of("taxeld/pose"):
        t, pose = seconds(message.header.stamp), message.pose.pose
        (said,) = (one for one in sent if abs(one["t"] - t) < 1e-6)
        at = pose.position
        assert (at.x, at.y, at.z) == (said["mean"]["x"], said["mean"]["y"], 0.2)
        yaw = 2 * math.atan2(pose.orientation.z, pose.orientation.w)
        assert yaw == pytest.approx(said["mean"]["theta"])
        assert message.header.frame_id == "table"
    assert heard.of("taxeld/modes")[0].poses[0].position.x == daemon.estimate["modes"][0]["x"]
    assert heard.status()[0] == (ros.OK, "converged")


def test_an_estimate_that_may_not_be_used_is_no_pose_and_its_status_is_told(
    daemon: Daemon, heard: Heard
) -> None:
    unusable: list[float] = []

    def inconsistent() -> None:
        unusable.append(daemon.say(valid=False, why=7, status=6)["t"])

    def ambiguous() -> None:
        unusable.append(daemon.say(status=2)["t"])

    with bridge("--stream", daemon.endpoint):
        until(lambda: heard.of("taxeld/pose"), daemon.say)
        until(lambda: (ros.WARN, "inconsistent") in heard.status(), inconsistent)
        told = {one.key: one.value for one in heard.of("diagnostics")[-1].status[0].values}
        assert (told["valid"], told["why"]) == ("False", "inconsistent")
        until(lambda: (ros.OK, "ambiguous") in heard.status(), ambiguous)
        before = len(heard.of("taxeld/pose"))
        until(lambda: len(heard.of("taxeld/pose")) > before, daemon.say)
    published = [seconds(message.header.stamp) for message in heard.of("taxeld/pose")]
    assert not [t for t in published if np.isclose(t, unusable, rtol=0.0, atol=1e-6).any()]


@pytest.mark.check
def test_without_a_daemon_that_is_said_once_and_told_as_stale_until_one_comes(
    tmp_path: Path, heard: Heard
) -> None:
    endpoint = f"ipc://{tmp_path}/stream"
    with bridge("--stream", endpoint) as process:
        line = logged(process, "no daemon")
        assert line == f"no daemon is heard at {endpoint}; is 'taxeld run' there? Waiting"
        until(heard.status)
        assert heard.status()[0] == (ros.STALE, ros.SILENT)
        daemon = Daemon(tmp_path)
        until(lambda: heard.of("taxeld/pose"), daemon.say)
        line = logged(process, "a daemon is heard")
        assert line == SERVED.format(endpoint)
        daemon.close()


def test_a_stream_of_another_version_ends_the_bridge_with_one_line(daemon: Daemon) -> None:
    with bridge("--stream", daemon.endpoint) as process:
        until(lambda: process.poll() is not None, lambda: daemon.say(v=1))
        assert process.returncode == 1
        said = process.stderr.read()
    assert said.startswith("the stream is of version 1, where this taxeld reads ")
    assert said.count("\n") == 1


def test_the_service_manager_is_told_that_the_bridge_is_ready_alive_and_how_it_is(
    daemon: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE_S)
        monkeypatch.setitem(ENVIRONMENT, "NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setitem(ENVIRONMENT, "WATCHDOG_USEC", "200000")
        with bridge("--stream", daemon.endpoint) as process:
            assert manager.recv(1000) == b"READY=1"
            said: list[str] = []

            def listen() -> None:
                daemon.say()
                said.append(manager.recv(1000).decode())

            until(lambda: "WATCHDOG=1" in said, listen)
            passed = re.compile(r"STATUS=a daemon is heard, [1-9]\d* poses passed on")
            until(lambda: passed.fullmatch(said[-1]), listen)
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
        bridge("--stream", daemon.endpoint),
    ):
        until(came.exists, daemon.say)
        hanging.send_signal(signal.SIGSTOP)
        modes = 200 * daemon.estimate["modes"]  # 11 kB a message
        for _ in range(400):
            last = daemon.say(modes=modes)
            time.sleep(0.002)
        until(lambda: seconds(heard.of("taxeld/pose")[-1].header.stamp) >= last["t"] - 1e-6)


def transforms(parent: str, child: str, x: float, yaw: float) -> dict[str, Any]:
    """A `tf2_msgs/TFMessage` of one transform."""
    turn = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    place = {"translation": {"x": x, "y": 0.25, "z": 0.5}, "rotation": turn}
    header = ros.header(time.time(), parent)
    return {"transforms": [{"header": header, "child_frame_id": child, "transform": place}]}


def test_transforms_become_the_robots_poses(
    here: Participant, daemon: Daemon, robot: Robot
) -> None:
    moving = here.writer("tf", "tf2_msgs/TFMessage", 10)
    fixed = here.writer("tf_static", "tf2_msgs/TFMessage", 1, LATCHED)
    fixed.write(transforms("link", "skin", 0.1, 0.0))
    given = ("--sensor-tf", "world", "skin", "--sensor-endpoint", robot.endpoint)
    with bridge("--stream", daemon.endpoint, *given):

        def go_on() -> None:
            moving.write(transforms("world", "link", 1.0, math.pi / 2))

        pose = until(robot.pose, go_on)
    assert (pose["x"], pose["y"], pose["theta"]) == pytest.approx((0.75, 0.35, math.pi / 2))
    assert 0.0 <= time.time() - pose["t"] < PATIENCE_S


def test_a_topic_of_poses_becomes_the_robots_poses_and_a_tilted_link_is_left_out(
    here: Participant, daemon: Daemon, robot: Robot
) -> None:
    writer = here.writer("arm/skin", "geometry_msgs/PoseStamped", 10)

    def tell(**turn: float) -> None:
        pose = {"position": {"x": 2.0, "y": -1.0, "z": 0.5}, "orientation": turn}
        writer.write({"header": ros.header(time.time()), "pose": pose})

    half = {"w": math.cos(0.15)}
    given = ("--sensor-topic", "/arm/skin", "--sensor-endpoint", robot.endpoint)
    with bridge("--stream", daemon.endpoint, *given) as process:
        pose = until(robot.pose, lambda: tell(z=math.sin(0.15), **half))
        assert (pose["x"], pose["y"], pose["theta"]) == pytest.approx((2.0, -1.0, 0.3))
        while robot.pose() is not None:
            pass
        for _ in range(5):
            tell(x=math.sin(0.15), **half)
        line = logged(process, "upright")
        assert line == "the skin's z axis is 17° from upright: such poses are left out"
        assert robot.pose() is None


@pytest.mark.check
def test_why_no_sensor_pose_comes_is_said_after_a_while(daemon: Daemon, tmp_path: Path) -> None:
    expected = {
        ("--sensor-topic", "arm/skim"): "no geometry_msgs/msg/PoseStamped came on /arm/skim in "
        f"domain {DOMAIN}; look at 'ros2 topic info /arm/skim' and ROS_DOMAIN_ID",
        ("--sensor-tf", "map", "skin"): "no transforms that move lead from the frame 'map' to "
        "'skin'; look at 'ros2 run tf2_tools view_frames'",
    }
    with ExitStack() as stack:
        bridges = []
        for k, given in enumerate(expected):
            where = ("--sensor-endpoint", f"ipc://{tmp_path}/robot{k}")
            bridges.append(stack.enter_context(bridge("--stream", daemon.endpoint, *given, *where)))
        for process, why in zip(bridges, expected.values(), strict=True):
            assert logged(process, "no sensor pose") == f"no sensor pose: {why}"


STREAM = ("--stream", "ipc:///tmp/x")


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ((), "CONFIG or --stream: name the daemon's configuration, or where it publishes"),
        (("--stream", "foo"), "--stream: 'foo' is no endpoint; use ipc:///path or tcp://127.0.0.1"),
        (("--stream", "tcp://robot:1"), "--stream: 'tcp://robot:1' is not local; use"),
        (
            (*STREAM, "--sensor-topic", "/skin"),
            "sensor_pose.endpoint: is empty, so the daemon takes no poses of a robot",
        ),
        (
            (*STREAM, "--sensor-topic", "/skin", "--sensor-endpoint", "tcp://10.0.0.1:9874"),
            "sensor_pose.endpoint: 'tcp://10.0.0.1:9874' is not of this machine",
        ),
        ((*STREAM, "--prefix", "a b"), "--prefix: 'a b' is no name of a ROS 2 topic"),
        ((*STREAM, "--z-m", "nan"), "--z-m: must be a height in metres"),
        (("nowhere.toml",), "nowhere.toml: unreadable configuration"),
    ],
)
def test_settings_that_cannot_be_bridged_are_one_line_that_names_them(
    arguments: tuple[str, ...], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", ENVIRONMENT["CYCLONEDDS_URI"])
    assert refused(*arguments, main=cli.main).startswith(fault)


def test_a_domain_that_dds_does_not_have_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    assert refused(*STREAM, main=cli.main) == "ROS_DOMAIN_ID: must be 0..232, not '233'\n"


@pytest.mark.parametrize(("sensor", "frame"), [("tcp://127.0.0.1:9874", "world"), ("", "sensor")])
def test_the_daemons_configuration_says_where_it_publishes_and_expects_the_robot(
    tmp_path: Path, sensor: str, frame: str
) -> None:
    path = configuration(tmp_path, sensor_pose={"endpoint": sensor})
    settings = cli.settings_of(cli._parser().parse_args([str(path)]), cli.load(path))
    assert settings.stream == f"ipc://{tmp_path}/stream"
    assert (settings.sensor_endpoint, settings.frame) == (sensor, frame)
