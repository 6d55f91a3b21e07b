"""The bridge and another vendor's DDS, in processes of their own: Debian's Fast DDS."""

import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds")

from tests.rig.clocks import until

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
        bridge("--stream", daemon.endpoint, "--frame", "table", "--z-m", "0.5"),
    ):
        until(lambda: said.exists() and "\n" in said.read_text(), daemon.say)
    _, frame, *numbers = said.read_text().splitlines()[0].split()
    mean, cov = daemon.estimate["mean"], daemon.estimate["cov"]
    expected = [mean["x"], mean["y"], 0.5, mean["theta"], cov[0][0], cov[2][2]]
    assert frame == "table"
    assert [float(n) for n in numbers] == pytest.approx(expected, rel=1e-12)


def test_transforms_of_fast_dds_become_the_robots_poses(
    peer: str, daemon: Daemon, robot: Robot
) -> None:
    given = ("--sensor-tf", "world", "skin", "--sensor-endpoint", robot.endpoint)
    with running(peer, "tell", str(DOMAIN)), bridge("--stream", daemon.endpoint, *given):
        poses = [until(robot.pose) for _ in range(3)]
    for pose in poses:
        place = pose["x"], pose["y"], pose["theta"]
        assert place == pytest.approx((0.75, 0.35, 1.5707963267948966))
    times = [pose["t"] for pose in poses]
    assert times == sorted(set(times))
