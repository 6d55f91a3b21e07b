"""The bridge as a process, between a daemon's own publisher and DDS in other processes."""

import json
import math
import os
import re
import signal
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.stream import messages

pytest.importorskip("cyclonedds")

from taxeld_ros2 import cli, convert
from taxeld_ros2 import ros_types as ros
from taxeld_ros2.dds import LATCHED, RELIABLE, Participant, last
from tests import logged as logged_as

from .loopback import DOMAIN, ENVIRONMENT, PATIENCE_S, Daemon, Lines, bridge, until

HEAR = Path(__file__).parent / "hear.py"
TOPICS = (
    "taxeld/pose:PoseWithCovarianceStamped", "taxeld/modes:PoseArray",
    "taxeld/markers:MarkerArray", "diagnostics:DiagnosticArray",
)  # fmt: skip


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    opened = Daemon(tmp_path)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def here() -> Participant:
    """This process as another ROS node."""
    os.environ["CYCLONEDDS_URI"] = ENVIRONMENT["CYCLONEDDS_URI"]
    return Participant(DOMAIN)


@pytest.fixture
def heard() -> "Iterator[Heard]":
    """All that a reader in another process hears."""
    reader = Lines([sys.executable, str(HEAR), *TOPICS])
    yield Heard(reader.lines)
    reader.close()


class Heard:
    """Messages by topic."""

    def __init__(self, lines: list[str]) -> None:
        self._lines = lines

    def of(self, topic: str) -> list[dict[str, Any]]:
        told = (json.loads(line) for line in list(self._lines))
        return [one["message"] for one in told if one["topic"] == topic]


def logged(process: Any, part: str) -> str:
    """The first line on standard error that has `part`, without its time and level."""
    for line in process.stderr:
        if part in line:
            return logged_as.messages(line)[0]
    raise AssertionError(f"{part!r} was not said")


def test_another_process_hears_poses_modes_markers_and_status(daemon: Daemon, heard: Heard) -> None:
    with bridge("--stream", daemon.endpoint, "--frame", "table", "--z-m", "0.2"):
        sent: dict[float, dict[str, Any]] = {}

        def go_on() -> None:
            said = daemon.say()
            sent[said["t"]] = said
            daemon.send(messages.PARTICLES)
            daemon.send(messages.HEALTH)

        until(lambda: len(heard.of("taxeld/pose")) >= 3, go_on)
        until(
            lambda: any(len(m["markers"][5]["points"]) == 2 for m in heard.of("taxeld/markers")),
            go_on,
        )
        until(
            lambda: any(len(d["status"][0]["values"]) == 10 for d in heard.of("diagnostics")),
            go_on,
        )
    for pose in heard.of("taxeld/pose"):
        stamp = pose["header"]["stamp"]
        t = stamp["sec"] + 1e-9 * stamp["nanosec"]
        (said,) = (message for at, message in sent.items() if abs(at - t) < 1e-6)
        at, turn = pose["pose"]["pose"]["position"], pose["pose"]["pose"]["orientation"]
        assert (at["x"], at["y"], at["z"]) == (said["mean"]["x"], said["mean"]["y"], 0.2)
        assert 2 * math.atan2(turn["z"], turn["w"]) == pytest.approx(said["mean"]["theta"])
        assert pose["header"]["frame_id"] == "table"
    assert heard.of("taxeld/modes")[0]["poses"][0]["position"]["x"] == daemon.estimate["map"]["x"]
    (status,) = heard.of("diagnostics")[0]["status"]
    assert (status["level"], status["message"]) == (convert.OK, "converged")


def test_an_estimate_that_may_not_be_used_is_no_pose_and_its_status_is_told(
    daemon: Daemon, heard: Heard
) -> None:
    with bridge("--stream", daemon.endpoint):
        until(lambda: heard.of("taxeld/pose"), daemon.say)

        def inconsistent() -> None:
            daemon.say(valid=False, status=6)

        until(
            lambda: any(
                d["status"][0]["message"] == "inconsistent" for d in heard.of("diagnostics")
            ),
            inconsistent,
        )
        before = len(heard.of("taxeld/pose"))
        for _ in range(20):
            inconsistent()
            time.sleep(0.01)
        last_valid = daemon.say()
        until(lambda: len(heard.of("taxeld/pose")) > before, daemon.say)
    for pose in heard.of("taxeld/pose")[before:]:
        stamp = pose["header"]["stamp"]
        assert stamp["sec"] + 1e-9 * stamp["nanosec"] >= last_valid["t"] - 1e-6


def test_without_a_daemon_that_is_said_once_and_told_as_stale_until_one_comes(
    tmp_path: Path, heard: Heard
) -> None:
    with bridge("--stream", f"ipc://{tmp_path}/stream") as running:
        line = logged(running, "no daemon")
        assert line == (
            f"no daemon is heard at ipc://{tmp_path}/stream; is 'taxeld run' there? Waiting"
        )
        until(lambda: heard.of("diagnostics"))
        (status,) = heard.of("diagnostics")[0]["status"]
        assert (status["level"], status["message"]) == (convert.STALE, convert.SILENT)
        daemon = Daemon(tmp_path)
        until(lambda: heard.of("taxeld/pose"), daemon.say)
        assert logged(running, "a daemon is heard").endswith(daemon.endpoint)
        daemon.close()


def test_a_daemon_of_another_version_ends_the_bridge_with_one_line(daemon: Daemon) -> None:
    with bridge("--stream", daemon.endpoint) as running:
        until(lambda: running.poll() is not None, lambda: daemon.say(v=2))
        assert running.returncode == 1
        assert running.stderr is not None
        assert running.stderr.read() == (
            f"{daemon.endpoint}: speaks version 2 of the stream, and this bridge version 1; "
            "install taxeld of one release on both sides\n"
        )


def test_the_service_manager_is_told_that_the_bridge_is_ready_alive_and_how_it_is(
    daemon: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE_S)
        monkeypatch.setitem(ENVIRONMENT, "NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setitem(ENVIRONMENT, "WATCHDOG_USEC", "200000")
        with bridge("--stream", daemon.endpoint) as running:
            assert manager.recv(1000) == b"READY=1"
            said: list[str] = []

            def listen() -> None:
                daemon.say()
                said.append(manager.recv(1000).decode())

            until(lambda: "WATCHDOG=1" in said, listen)
            passed = re.compile(r"STATUS=a daemon is heard, [1-9]\d* poses passed on")
            until(lambda: passed.fullmatch(said[-1]), listen)
            running.terminate()
            until(lambda: manager.recv(1000) == b"STOPPING=1")


def test_what_is_no_stream_ends_the_bridge_with_one_line(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/stream"
    with (
        bridge("--stream", endpoint) as running,
        zmq.Context() as context,
        context.socket(zmq.PUB) as other,
    ):
        other.setsockopt(zmq.LINGER, 0)
        other.bind(endpoint)
        until(
            lambda: running.poll() is not None,
            lambda: other.send_multipart([messages.ESTIMATE, b"\xc1", b"0"]),
        )
        assert running.returncode == 1
        assert running.stderr is not None
        assert running.stderr.read() == f"{endpoint}: what is published there is no taxeld's\n"


def test_a_reader_that_hangs_costs_the_others_nothing(daemon: Daemon, heard: Heard) -> None:
    """A reliable one, for whom DDS keeps messages until it has no more room."""
    hanging = Lines([sys.executable, str(HEAR), *TOPICS])
    cloud = {"xytheta": [[0.1, 0.2, 0.3]] * 400, "weight": [1.0] * 400}
    try:
        with bridge("--stream", daemon.endpoint):
            until(lambda: hanging.lines and heard.of("taxeld/pose"), daemon.say)
            hanging.signal(signal.SIGSTOP)
            for _ in range(400):
                said = daemon.say()
                daemon.send(messages.PARTICLES, **cloud)
                time.sleep(0.002)

            def is_heard() -> bool:
                stamp = heard.of("taxeld/pose")[-1]["header"]["stamp"]
                return bool(stamp["sec"] + 1e-9 * stamp["nanosec"] >= said["t"] - 1e-6)

            until(is_heard, lambda: None)
    finally:
        hanging.signal(signal.SIGCONT)
        hanging.close()


class Robot:
    """What the daemon would hear as the robot's poses."""

    def __init__(self, place: Path) -> None:
        self.endpoint = f"ipc://{place}/robot"
        self._context: zmq.Context[Any] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SUBSCRIBE, messages.SENSOR_POSE)
        self._socket.connect(self.endpoint)

    def pose(self) -> dict[str, float] | None:
        if not self._socket.poll(20):
            return None
        topic, body, stamp = self._socket.recv_multipart()
        pose: dict[str, float] = msgpack.unpackb(body)
        assert topic == messages.SENSOR_POSE
        assert float(stamp) == pytest.approx(pose["t"], abs=1e-6)
        return pose

    def close(self) -> None:
        self._socket.close()
        self._context.term()


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    opened = Robot(tmp_path)
    yield opened
    opened.close()


def stamped(parent: str, child: str, x: float, yaw: float) -> ros.TFMessage:
    turn = ros.Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    place = ros.Transform(ros.Vector3(x, 0.25, 0.5), turn)
    return ros.TFMessage([ros.TransformStamped(convert.header(time.time(), parent), child, place)])


def test_transforms_become_the_robots_poses(
    here: Participant, daemon: Daemon, robot: Robot
) -> None:
    moving = here.writer("tf", ros.TFMessage, last(10, RELIABLE))
    fixed = here.writer("tf_static", ros.TFMessage, last(1, RELIABLE, LATCHED))
    fixed.write(stamped("link", "skin", 0.1, 0.0))
    given = ("--sensor-tf", "world", "skin", "--sensor-endpoint", robot.endpoint)
    with bridge("--stream", daemon.endpoint, *given):
        pose = until(robot.pose, lambda: moving.write(stamped("world", "link", 1.0, math.pi / 2)))
    assert (pose["x"], pose["y"]) == pytest.approx((0.75, 0.35))
    assert pose["theta"] == pytest.approx(math.pi / 2)
    assert 0.0 <= time.time() - pose["t"] < PATIENCE_S


def test_a_topic_of_poses_becomes_the_robots_poses_and_a_tilted_link_is_left_out(
    here: Participant, daemon: Daemon, robot: Robot
) -> None:
    writer = here.writer("arm/skin", ros.PoseStamped, last(10, RELIABLE))

    def tell(turn: ros.Quaternion) -> None:
        pose = ros.Pose(ros.Point(2.0, -1.0, 0.5), turn)
        writer.write(ros.PoseStamped(convert.header(time.time(), "world"), pose))

    upright = ros.Quaternion(0.0, 0.0, math.sin(0.15), math.cos(0.15))
    tipped = ros.Quaternion(math.sin(0.15), 0.0, 0.0, math.cos(0.15))
    given = ("--sensor-topic", "/arm/skin", "--sensor-endpoint", robot.endpoint)
    with bridge("--stream", daemon.endpoint, *given) as running:
        pose = until(robot.pose, lambda: tell(upright))
        assert (pose["x"], pose["y"]) == (2.0, -1.0)
        assert pose["theta"] == pytest.approx(0.3)
        while robot.pose() is not None:
            pass
        for _ in range(5):
            tell(tipped)
        assert logged(running, "upright") == (
            "the skin's z axis is 17° from upright: such poses are left out"
        )
        assert robot.pose() is None


def test_why_no_sensor_pose_comes_is_said_after_a_while(
    here: Participant, daemon: Daemon, tmp_path: Path
) -> None:
    """No such topic, a topic of another type, and a frame that nobody names."""
    _writer = here.writer("arm/other", ros.PoseArray, last(10, RELIABLE))
    expected = {
        ("--sensor-topic", "/arm/skim"): f"nothing publishes /arm/skim in domain {DOMAIN}",
        ("--sensor-topic", "arm/other"): "/arm/other is of geometry_msgs/msg/PoseArray, not of "
        "geometry_msgs/msg/PoseStamped",
        ("--sensor-tf", "map", "nowhere"): "no transform names the frame 'map'",
    }
    with ExitStack() as stack:
        running = []
        for k, given in enumerate(expected):
            where = ("--sensor-endpoint", f"ipc://{tmp_path}/robot{k}")
            running.append(stack.enter_context(bridge("--stream", daemon.endpoint, *given, *where)))
        for process, why in zip(running, expected.values(), strict=True):
            assert logged(process, "no sensor pose") == f"no sensor pose: {why}"


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ([], "CONFIG or --stream: name the daemon's configuration, or where it publishes"),
        (["--stream", "foo"], "--stream: 'foo' is no endpoint; use ipc:///path or tcp://127.0.0.1"),
        (["--stream", "tcp://robot:1"], "--stream: 'tcp://robot:1' is not local; use"),
        (["--stream", "ipc:///tmp/x", "--domain", "233"], "--domain: must be 0..232, not '233'"),
        (
            ["--stream", "ipc:///tmp/x", "--sensor-topic", "/skin"],
            "sensor_pose.endpoint: is empty, so the daemon takes no poses of a robot",
        ),
        (
            [
                *("--stream", "ipc:///tmp/x", "--sensor-topic", "/skin"),
                *("--sensor-endpoint", "tcp://10.0.0.1:9874"),
            ],
            "sensor_pose.endpoint: 'tcp://10.0.0.1:9874' is not of this machine",
        ),
        (
            ["--stream", "ipc:///tmp/x", "--prefix", "a b"],
            "--prefix: 'a b' is no name of a ROS 2 topic",
        ),
        (["--stream", "ipc:///tmp/x", "--z-m", "nan"], "--z-m: must be a height in metres"),
        (["nowhere.toml"], "nowhere.toml: unreadable configuration"),
    ],
)
def test_what_cannot_be_bridged_is_one_line_that_names_it(
    arguments: list[str], fault: str, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", ENVIRONMENT["CYCLONEDDS_URI"])
    assert cli.main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith(fault)
    assert said.count("\n") == 1


def test_the_daemons_configuration_says_where_it_publishes_and_expects_the_robot(
    tmp_path: Path,
) -> None:
    path = tmp_path / "can0.toml"
    path.write_text(
        '[source]\nkind = "replay"\npath = "."\n[scene]\nbundle = "box"\n'
        f'[sensor_pose]\nendpoint = "tcp://127.0.0.1:9874"\n'
        f'[publish]\nendpoints = ["ipc://{tmp_path}/stream"]\n'
    )
    args = cli._parser().parse_args([str(path), "--sensor-tf", "world", "skin"])
    settings = cli.settings_of(args, cli.load(path))
    assert settings.stream == f"ipc://{tmp_path}/stream"
    assert settings.sensor_endpoint == "tcp://127.0.0.1:9874"
    assert settings.frame == "world"
    path.write_text(path.read_text().replace("tcp://127.0.0.1:9874", ""))
    args = cli._parser().parse_args([str(path)])
    assert cli.settings_of(args, cli.load(path)).frame == "sensor"
