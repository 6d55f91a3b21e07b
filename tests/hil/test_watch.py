"""`taxeld-hil watch` and `emulate` name what is wrong with an endpoint, in one line."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from taxeld_hil.cli import main

DEADLINE_S = 60.0


@pytest.mark.parametrize("endpoint", ["foo", "tcp://", "tcp://a:b", "tcp://127.0.0.1:99999", ""])
@pytest.mark.parametrize("name", ["watch", "emulate"])
def test_an_endpoint_that_is_none_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, endpoint: str
) -> None:
    arguments = {
        "watch": ["--bundle", "box", "--endpoint", endpoint],
        "emulate": ["demo", "--link", str(tmp_path / "skin"), "--out", str(tmp_path / "out"),
                    "--poses", endpoint],
    }  # fmt: skip
    assert main([name, *arguments[name]]) == 2
    printed, errors = capsys.readouterr()
    option = "--endpoint" if name == "watch" else "--poses"
    assert (printed, errors.count("\n")) == ("", 1)
    assert errors.startswith(f"{option}: '{endpoint}' ")
    assert "; use ipc:///path or tcp://" in errors


def test_a_watcher_of_nobody_says_so(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/nobody"
    command = ["-m", "taxeld_hil.cli", "watch", "--bundle", "box", "--endpoint", endpoint]
    with subprocess.Popen(
        [sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as watcher:
        assert watcher.stderr is not None
        said = watcher.stderr.readline()
        watcher.send_signal(signal.SIGINT)
        printed, rest = watcher.communicate(timeout=DEADLINE_S)
    assert said == f"nothing comes from {endpoint} so far; is a daemon there?\n"
    assert (watcher.returncode, printed, rest) == (0, "", "")


def test_a_run_leaves_a_configuration_that_is_there_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "config.toml"
    mine.write_text("mine", encoding="utf-8")
    assert main(["run", "demo", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert said == f"--out: {mine} is there already; name another directory\n"
    assert mine.read_text(encoding="utf-8") == "mine"
