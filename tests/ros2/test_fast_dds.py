"""The bridge and another vendor's DDS, in processes of their own: Debian's Fast DDS."""

import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds")

from tests.rig.clocks import until
from tests.rig.configurations import configuration

from .loopback import DOMAIN, Daemon, Robot, bridge, running

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
