"""The guide for a first robot: its commands print what it shows, links lead somewhere, and the
publisher beside it is heard."""

import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zmq
from deploy import manuals

from taxeld.door.heard import as_pose
from taxeld.layout import read as layouts
from taxeld.stream import topics
from tests.pages import FENCED, NUMBER
from tests.rig.skins import table_of
from tests.rig.sockets import Sockets

pytestmark = pytest.mark.check

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs" / "first-robot.md"
PAGES = [*sorted((ROOT / "docs").glob("*.md")), *sorted(ROOT.glob("*.md"))]


def shown(page: Path, language: str) -> list[str]:
    """The blocks of a page in a language."""
    blocks = FENCED.findall(page.read_text(encoding="utf-8"))
    return [text for of, text in blocks if of == language]


def follow(command: str, place: Path) -> subprocess.CompletedProcess[str]:
    """Run a command of the guide as a user would, in the guide's directory."""
    environment = os.environ | {
        "XDG_RUNTIME_DIR": str(place),
        "PATH": f"{place / 'bin'}:{os.environ['PATH']}",
    }
    command = command.replace("python ", f"{sys.executable} ")
    return subprocess.run(
        command, shell=True, cwd=place, env=environment, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the guide is followed, after its bundle was built as it says."""
    made = tmp_path_factory.mktemp("guide")
    shutil.copy(ROOT / "examples" / "bracket.stl", made)
    (made / "bin").mkdir()
    for name, module in manuals.PROGRAMS.items():
        program = made / "bin" / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {module} "$@"\n')
        program.chmod(0o755)
    (made / "bin" / "python").symlink_to(sys.executable)
    [build] = [text for text in shown(GUIDE, "sh") if text.startswith("taxeld-train build")]
    built = follow(build, made)
    assert built.returncode == 0, built.stderr
    return made


def test_the_guides_commands_print_what_it_shows(place: Path) -> None:
    """In their order, as later ones use what earlier ones wrote. Numbers may differ; one of which
    nothing is shown ends well."""
    followed = [each for text in shown(GUIDE, "console") for each in text.split("$ ")[1:]]
    assert len(followed) >= 4
    for command, *lines in map(str.splitlines, followed):
        ran = follow(command, place)
        if not lines:
            assert ran.returncode == 0, ran.stderr
            continue
        said = [NUMBER.sub("N", line) for line in (ran.stdout + ran.stderr).splitlines()]
        assert said == [NUMBER.sub("N", line) for line in lines], command


def following(ran: subprocess.CompletedProcess[str]) -> str:
    """The command that another one prints as the next."""
    assert ran.returncode == 0, ran.stderr
    return re.findall(r"^next\W+(.*)", ran.stdout, re.MULTILINE)[-1]


SMALL = layouts.load("wrap:modules=8,radius_m=0.03")


@pytest.mark.parametrize("own", [True, False], ids=["of modules", "of an array"])
def test_from_a_layout_to_a_graded_run_each_command_is_printed_by_the_one_before(
    place: Path, tmp_path: Path, own: bool
) -> None:
    """With a mesh in place of MESH. The run is on the fake clock."""
    shutil.copy(place / "bracket.stl", tmp_path)
    (tmp_path / "bin").symlink_to(place / "bin")
    numbered = replace(SMALL, uid=SMALL.uid if own else np.arange(1001, 1001 + len(SMALL)))
    (tmp_path / "my skin.csv").write_text(table_of(numbered, uid=True), encoding="ascii")
    looked = following(follow("taxeld layout 'my skin.csv'", tmp_path))
    build = following(follow(looked.replace("MESH", "bracket.stl"), tmp_path))
    assert "--table" in build
    ran = follow(following(follow(build, tmp_path)) + " --clock fake", tmp_path)
    assert ran.returncode in (0, 1), ran.stderr  # such samplers need not find the object
    said = dict(line.partition(": ")[::2] for line in ran.stdout.splitlines())
    assert said.keys() & {"passed", "failed"}, ran.stdout
    for command in (
        f"{said['see it']} --save seen.rrd",
        said["next"].replace("can:can0", "can:nothing0"),
    ):
        done = follow(command, tmp_path)
        assert done.returncode == 0, done.stderr
    checked = follow("taxeld check robot.toml", tmp_path).stderr.splitlines()
    assert [line.partition(":")[0] for line in checked] == ["source.channel"] * own, checked


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        name, _, anchor = target.partition("#")
        if "://" in target:
            continue
        other = page if not name else (page.parent / name)
        assert other.exists(), target
        if anchor and other.suffix == ".md":
            assert anchor in anchors(other), target


def anchors(page: Path) -> set[str]:
    """Of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


def test_the_example_publisher_is_heard_as_a_robot(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/robot"
    command = [sys.executable, str(ROOT / "examples" / "publish_pose.py"), endpoint]
    with subprocess.Popen(command) as publishing, Sockets() as sockets:
        parts = sockets.subscriber(endpoint, topics.SENSOR_POSE).recv_multipart()
        publishing.terminate()
    t, x, y, _ = as_pose(parts)  # type: ignore[misc]
    assert 0.0 <= time.time() - t < 60.0, "Unix seconds"
    assert max(abs(x), abs(y)) < 1.0
    assert float(parts[2]) == pytest.approx(t, abs=1e-5)


def test_a_second_example_publisher_at_a_port_says_so_in_a_line() -> None:
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        endpoint = f"tcp://127.0.0.1:{socket.bind_to_random_port('tcp://127.0.0.1')}"
        command = [sys.executable, str(ROOT / "examples" / "publish_pose.py"), endpoint]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (1, 1)
    assert ended.stderr.startswith(f"{endpoint}: Address already in use")
    assert ended.stderr.endswith("stop the program that has it, or name another\n")
