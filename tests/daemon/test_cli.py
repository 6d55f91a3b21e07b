"""Commands: what they print and write, and one clear line with status 2 for whatever is wrong."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.rig.commands import printed, refused
from tests.rig.configurations import Table
from tests.rig.recorded import golden, write_golden

DECLARED = "501#3C0301000C8C"  # one module of 12 channels


FAULTS = [  # of what a run opens; those of keys alone are of the configuration's tests
    ("scene", "bundle", "sphere", "scene.bundle: no bundle 'sphere'; shipped are box, drill, mug"),
    (
        "skin",
        "layout",
        "cylinder:rows=5,columns=8,radius_m=0.04,pitch_m=0.015",
        "scene.bundle: box is for the layout cylinder:rows=5,columns=16",
    ),
    ("skin", "full_scale_depth_m", 0.004, "skin.full_scale_depth_m: is 0.004, but box"),
    ("skin", "calibration", "c.toml", "skin.calibration: c.toml: unreadable (No such file or dir"),
    ("filter", "proposal", "ddpm-7", "filter.proposal: box has no 'ddpm-7'; it has auto, "),
    ("curve", "directory", "/nowhere", "curve.directory: /nowhere/server.key_secret cannot be"),
]


def test_check_passes_what_is_fine(tmp_path: Path) -> None:
    assert printed("check", golden(tmp_path)) == f"{tmp_path}/config.toml: fine\n"


@pytest.mark.parametrize(("table", "key", "value", "line"), FAULTS, ids=[f[1] for f in FAULTS])
def test_a_fault_of_what_a_run_opens_is_one_line_and_status_2(
    tmp_path: Path, table: str, key: str, value: object, line: str
) -> None:
    path = golden(tmp_path, **{table: {key: value}})
    for command in ("check", "run"):
        assert refused(command, path).startswith(line)


@pytest.mark.parametrize("command", ["check", "export", "replay", "status", "advise", "calibrate"])
def test_a_missing_file_is_one_line_and_status_2(command: str) -> None:
    more = {
        "calibrate": ["--out", "x.toml"],
        "export": ["--out", "x"],
        "advise": ["--candidates", "x.csv"],
    }
    assert "nowhere" in refused(command, "/nowhere.toml", *more.get(command, []))


ELSEWHERE = (
    "; a session does not hold its layout and its bundle: name them in {place}/config.toml, by "
    "whole paths, or in another file with --config\n"
)


@pytest.mark.parametrize(
    ("tables", "log", "begin", "end"),
    [
        (None, None, "{place}: is no session (it has no ", "make one\n"),
        (
            {},
            "(1.0) can0 101#43\n",
            "{place}: is a session of another version",
            "record it again\n",
        ),
        ({"scene": {"bundle": "objects/bracket"}}, None, "scene.bundle: ", ELSEWHERE),
        ({"skin": {"layout": "skin.json"}}, None, "skin.layout: ", ELSEWHERE),
    ],
    ids=["none", "damaged", "the bundle stayed elsewhere", "the layout stayed elsewhere"],
)
def test_a_session_that_cannot_be_replayed_says_so(
    tmp_path: Path, tables: dict[str, Table] | None, log: str | None, begin: str, end: str
) -> None:
    write_golden(tmp_path)
    if tables is not None:
        golden(tmp_path, **tables)
    if log:
        (tmp_path / "arrivals").write_text(log, encoding="ascii")
    told = refused("replay", tmp_path)
    assert told.startswith(begin.format(place=tmp_path))
    assert told.endswith(end.format(place=tmp_path))


def test_replay_into_a_closed_pipe_ends_quietly() -> None:
    place = Path(__file__).with_name("session")
    command = f"{sys.executable} -m taxeld.cli replay {place} | head -n 1"
    ran = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert (ran.stderr, ran.stdout[:6]) == ("", '{"v":3')
