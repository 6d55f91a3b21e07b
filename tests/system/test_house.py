"""Rules of the whole house."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from taxeld import __version__
from taxeld.config import file as config_file

ROOT = Path(__file__).parents[2]


def test_the_version_is_the_same_wherever_it_stands() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == __version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## (\S+)(?:, \d{4}-\d\d-\d\d)?$", changes, re.MULTILINE)
    assert sections[0] == __version__


def test_contributing_lists_every_make_target_and_files_that_are_there() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    lines = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for target in set(" ".join(lines).split()) - {"clean"}:
        assert f"`make {target}`" in text, target
    for name in re.findall(r"`(\w+/[\w/]+\.\w+)`", text):
        places = (ROOT / part / name for part in (".", "daemon", "training", "hil"))
        assert any(place.is_file() for place in places), name


def test_what_is_to_be_installed_comes_from_the_clone_or_a_wheel_and_from_no_index() -> None:
    """taxeld is on no index; pip knows the packages of its extras by their own names."""
    texts = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").glob("*")]
    for root in ("daemon", "hil", "training", "ros2"):
        texts += (ROOT / root).rglob("*.py")
    for path in filter(Path.is_file, texts):
        text = path.read_text(encoding="utf-8")
        lines = [line for line in text.splitlines() if re.search(r"pip install|taxeld\[", line)]
        for line in lines:
            named = re.findall(r"(\S*)\[[a-z0-9,{}]+\]'", line)
            assert {one.strip("`'") for one in named} <= {".", "WHEEL"}, line


def test_the_way_of_a_scan_names_methods_that_are_there() -> None:
    _, block, _ = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("```")
    rooms = (ROOT / "daemon", ROOT / "firmware_protocol")
    files = [path.read_text(encoding="utf-8") for room in rooms for path in room.rglob("*.py")]
    named = re.findall(r"\b([A-Z]\w+)\.(\w+)", block)
    assert len(named) > 10
    for owner, name in named:
        assert any(f"class {owner}" in text and f"def {name}(" in text for text in files), name


def test_the_example_configuration_is_fine() -> None:
    assert config_file.load(ROOT / "examples" / "can0.toml").source.channel == "can0"


def pins(text: str) -> dict[str, str]:
    found = re.findall(r"^([\w.-]+)==([^\s\\]+)", text, re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def test_the_lock_pins_every_dependency_at_the_version_that_was_tested() -> None:
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    tested = pins((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    locked = pins(lock)
    assert locked.items() <= tested.items()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = {re.split(r"[<>=~!]", d)[0].lower() for d in project["dependencies"]}
    assert asked <= locked.keys()
    for entry in re.split(r"\n(?=\S)", lock)[1:]:
        assert re.fullmatch(r"[\w.-]+==\S+( \\\n    --hash=sha256:[0-9a-f]{64})+\n?", entry), entry
    assert "://" not in lock


@pytest.mark.check
def test_the_benchmark_of_the_service_runs() -> None:
    command = [sys.executable, "benchmarks/service.py", "--seconds", "0.5"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert "touched all the time: a core's share" in ran.stdout
