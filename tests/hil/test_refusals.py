"""A wrong command line of `taxeld-hil` is refused with one line, before any work is done."""

import shlex
from pathlib import Path

import pytest

from taxeld_hil.cli import main

NO_FOAM = "no foam 'marble'; there are scene, typical, poor, stiff; a layout is given by --layout\n"
NO_BUNDLE = "scene.bundle: no bundle 'party'"
NO_ENDPOINT = "; use ipc:///path or tcp://"
EMULATE = "emulate demo --link {place}/skin --out {place}/out --poses"

WRONG = [  # a command line, and words of its line
    ("run demo --random 0", "--random: must be 1..120 minutes"),
    ("grade {place}/none", "none: is no session"),
    ("run demo --foam marble", NO_FOAM),
    ("run demo --clock fake --object party", NO_BUNDLE),
    ("run demo --advised", "advised: such a robot runs on the fake clock alone: --clock fake\n"),
    ("emulate links --can vcan0 --poses ipc:///x --out {place}/out", "layouts: several links run"),
    ("run party", "no scenario 'party'; shipped are "),
    ("matrix demo --foam marble --out {place}/out", NO_FOAM),
    ("matrix demo --seeds 0 --out {place}/out", "--seeds must be at least 1"),
    ("matrix demo --workers 0 --out {place}/out", "--workers must be at least 1"),
    (f"{EMULATE} foo", "--poses: 'foo' "),
    (f"{EMULATE} tcp://", NO_ENDPOINT),
    (f"{EMULATE} tcp://127.0.0.1:99999", NO_ENDPOINT),
    ("accept {place}", "{place}: is no session (it has no config.toml)"),
]


@pytest.mark.parametrize(("line", "expected"), WRONG)
def test_a_wrong_command_line_is_refused_with_one_line_and_leaves_nothing(
    line: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("{}", encoding="utf-8")
    assert main([word.format(place=tmp_path) for word in shlex.split(line)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert expected.format(place=tmp_path) in error
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_run_leaves_a_configuration_that_is_there_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "config.toml"
    mine.write_text("mine", encoding="utf-8")
    assert main(["run", "demo", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert said == f"--out: {mine} is there already; name another directory\n"
    assert mine.read_text(encoding="utf-8") == "mine"
