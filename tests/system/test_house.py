"""Rules of the whole house."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from taxeld import __version__

ROOT = Path(__file__).parents[2]
PACKAGES = ("daemon", "hil", "training", "ros2")
INSTALLED = re.compile(r"pip install|taxeld\[")


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_version_is_the_same_wherever_it_stands() -> None:
    sections = re.findall(
        r"^## (\S+)(?:, \d{4}-\d\d-\d\d)?$", text_of("CHANGELOG.md"), re.MULTILINE
    )
    released = next(each for each in sections if each != "Unreleased")
    assert PROJECT["version"] == __version__ == released


def test_contributing_lists_every_make_target_and_files_that_are_there() -> None:
    text = text_of("CONTRIBUTING.md")
    targets = " ".join(re.findall(r"^\.PHONY: (.*)$", text_of("Makefile"), re.MULTILINE)).split()
    assert {each for each in targets if f"`make {each}`" not in text} == {"clean"}
    named = re.findall(r"`(\w+/[\w/]+\.\w+)`", text)
    parts = (ROOT, *(ROOT / part for part in ("daemon", "training", "hil")))
    assert [each for each in named if not any((part / each).is_file() for part in parts)] == []


def test_what_is_to_be_installed_comes_from_the_clone_or_a_wheel_and_from_no_index() -> None:
    """taxeld is on no index; pip knows the packages of its extras by their own names."""
    texts = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").glob("*.*")]
    texts += [path for room in PACKAGES for path in (ROOT / room).rglob("*.py")]
    lines = (line for path in texts for line in path.read_text(encoding="utf-8").splitlines())
    named = (
        re.findall(r"(\S*)\[[a-z0-9,{}]+\]'", line) for line in lines if INSTALLED.search(line)
    )
    assert {one.strip("`'") for each in named for one in each} <= {".", "WHEEL"}


def test_the_way_of_a_scan_names_methods_that_are_there() -> None:
    _, block, _ = text_of("docs/architecture.md").split("```")
    rooms = (ROOT / "daemon", ROOT / "firmware_protocol")
    files = [path.read_text(encoding="utf-8") for room in rooms for path in room.rglob("*.py")]
    named = re.findall(r"\b([A-Z]\w+)\.(\w+)", block)
    assert len(named) > 10
    for owner, name in named:
        assert any(f"class {owner}" in text and f"def {name}(" in text for text in files), name


def pins(name: str) -> dict[str, str]:
    found = re.findall(r"^([\w.-]+)==([^\s\\]+)", text_of(name), re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", package).lower(): version for package, version in found}


def test_the_lock_pins_every_dependency_at_the_version_that_was_tested() -> None:
    locked = pins("requirements.lock")
    assert locked.items() <= pins("constraints.txt").items()
    assert {re.split(r"[<>=~!]", d)[0].lower() for d in PROJECT["dependencies"]} <= locked.keys()
    entry = r"(#.*\n)*[\w.-]+==\S+( \\\n    --hash=sha256:[0-9a-f]{64})+\n?"
    assert re.fullmatch(rf"({entry})+", text_of("requirements.lock"))


@pytest.mark.check
def test_the_benchmark_of_the_service_runs() -> None:
    command = [sys.executable, "benchmarks/service.py", "--seconds", "0.5"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert "touched all the time: a core's share" in ran.stdout
