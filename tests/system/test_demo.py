"""The demo end to end: real processes, a pseudo-terminal, ZeroMQ, and a session to replay."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests import pages

ROOT = Path(__file__).parents[2]
SCENARIO = 'bundle = "box"\ncontacts = 2\n'


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A short demo's session, and what it printed."""
    place = tmp_path_factory.mktemp("demo")
    (place / "short.toml").write_text(SCENARIO, encoding="utf-8")
    command = ["-m", "taxeld_hil.cli", "run", str(place / "short.toml"), "--out", str(place / "s")]
    done = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode in (0, 1), done.stderr  # two touches may not be enough
    assert done.stderr == ""
    return place / "s", done.stdout


def test_a_demo_prints_what_the_readme_shows_and_then_its_grade(ran: tuple[Path, str]) -> None:
    """Numbers may differ, and so may spaces."""

    def plain(text: str) -> list[str]:
        return [" ".join(pages.NUMBER.sub("N", line).split()) for line in text.splitlines()]

    shown = dict(pages.FENCED.findall((ROOT / "README.md").read_text(encoding="utf-8")))["console"]
    command, *table, error = plain(shown)
    printed = plain(ran[1])
    assert (command, table[:3]) == ("$ make demo", printed[1:4])
    assert set(table) <= set(printed[:4]), "more touches, of the same form"
    assert error in printed
    assert any(line.startswith("total ") for line in printed), "the latencies"
    *_, verdict, see, following = ran[1].splitlines()
    assert verdict.split(":")[0] in ("passed", "failed")
    assert see == f"see it: taxeld view {ran[0]}"
    assert following == "next: taxeld init robot.toml --source can:can0 --bundle box"
