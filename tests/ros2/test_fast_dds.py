"""The bridge and another vendor's DDS, in processes of their own: Debian's Fast DDS."""

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from taxeld.stream import messages

pytest.importorskip("cyclonedds")

from .loopback import DOMAIN, Daemon, Lines, bridge, until
from .test_bridge import Robot

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


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    opened = Daemon(tmp_path)
    yield opened
    opened.close()


def test_fast_dds_reads_every_topic_of_the_bridge(peer: str, daemon: Daemon) -> None:
    hearing = Lines([peer, "hear", str(DOMAIN)])

    def of(topic: str) -> list[list[str]]:
        return [line.split() for line in list(hearing.lines) if line.startswith(topic)]

    def has_particles() -> bool:
        return any("particles:0:2" in words for words in of("markers"))

    def go_on() -> None:
        daemon.say()
        daemon.send(messages.PARTICLES)
        daemon.send(messages.HEALTH)

    try:
        with bridge("--stream", daemon.endpoint, "--frame", "table", "--z-m", "0.5"):
            for topic in ("pose", "modes", "diagnostics"):
                until(lambda topic=topic: of(topic), go_on)  # type: ignore[misc]
            until(has_particles, go_on)
    finally:
        hearing.close()
    mean, cov = daemon.estimate["mean"], daemon.estimate["cov"]
    _, _, frame, *numbers = of("pose")[0]
    expected = [mean["x"], mean["y"], 0.5, mean["theta"], cov[0][0], cov[0][1], cov[0][2]]
    assert frame == "table"
    assert [float(n) for n in numbers] == pytest.approx([*expected, cov[2][2]], rel=1e-12)
    assert of("modes")[0] == ["modes", "1", repr(daemon.estimate["modes"][0]["x"])]
    modes = ["modes:0:3", *["modes:2:0"] * 4]
    assert ["markers", "6", *modes, "particles:0:2"] in of("markers")
    assert " ".join(of("diagnostics")[0][:3]) == "diagnostics 0 converged,"


@pytest.mark.parametrize(
    ("source", "place"),
    [
        (("--sensor-tf", "world", "skin"), (0.75, 0.35, 1.5707963267948966)),
        (("--sensor-topic", "/skin"), (2.0, -1.0, 0.3)),
    ],
)
def test_transforms_and_poses_of_fast_dds_become_the_robots_poses(
    peer: str,
    daemon: Daemon,
    tmp_path: Path,
    source: tuple[str, ...],
    place: tuple[float, float, float],
) -> None:
    telling, robot = Lines([peer, "tell", str(DOMAIN)]), Robot(tmp_path)
    try:
        with bridge("--stream", daemon.endpoint, *source, "--sensor-endpoint", robot.endpoint):
            poses = [until(robot.pose) for _ in range(3)]
    finally:
        telling.close()
        robot.close()
    for pose in poses:
        assert (pose["x"], pose["y"], pose["theta"]) == pytest.approx(place)
    times = [pose["t"] for pose in poses]
    assert times == sorted(set(times))
