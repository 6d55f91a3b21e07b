"""The demo end to end: real processes, a pseudo-terminal, ZeroMQ, and a session to replay."""

import subprocess
import sys
from pathlib import Path

import pytest

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


def test_the_table_has_a_line_for_each_contact_and_the_latencies(ran: tuple[Path, str]) -> None:
    lines = ran[1].splitlines()
    assert [line.split()[0] for line in lines[2:4]] == ["1", "2"]
    assert all(int(line.split()[1]) > 0 for line in lines[2:4])
    p, radius = lines[1].index("  radius"), lines[1].index("]  likeliest") + 1
    assert all(line[:p].endswith("%") and float(line[p:radius]) > 0.0 for line in lines[2:4])
    assert any(line.startswith("total ") for line in lines)
    assert any(line[6:].startswith("accuracy: ") for line in lines)
    assert lines[-3].split(":")[0] in ("passed", "failed")
    assert lines[-2:] == [
        f"see it: taxeld view {ran[0]}",
        "next: taxeld init robot.toml --source can:can0 --bundle box",
    ]
