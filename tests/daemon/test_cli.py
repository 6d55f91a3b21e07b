"""Commands: what they print and write, and one clear line with status 2 for whatever is wrong."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import asdict, replace
from operator import attrgetter
from pathlib import Path
from typing import get_type_hints

import pytest

from taxeld.config.file import load, parse
from taxeld.config.gate import keys_of
from taxeld.config.tables import Config, SkinConfig
from taxeld.proposals import bundle
from tests.rig.commands import printed, refused
from tests.rig.configurations import Table
from tests.rig.recorded import golden, write_golden

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


POSES, LAYOUT = "tcp://127.0.0.1:9874", SkinConfig().layout
LARGE = "cylinder:rows=31,columns=80,radius_m=0.2,pitch_m=0.015"
FLAGS = ["--source", "slcan:/dev/ttyACM0", "--bundle", "box", "--poses", POSES]


def box_of(place: Path, pattern: str, changed: str) -> Path:
    """A copy of the shipped box whose bundle.json says something else."""
    box = Path(shutil.copytree(bundle.find("box"), place / "box"))
    text = (box / "bundle.json").read_text(encoding="utf-8")
    (box / "bundle.json").write_text(re.sub(pattern, changed, text, count=1), encoding="utf-8")
    return box


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (FLAGS, {"scene.bundle": "box", "skin.layout": LAYOUT, "sensor_pose.endpoint": POSES}),
        (["--source", "can:can0", "--layout", LAYOUT], {"scene.names": (), "skin.layout": LAYOUT}),
        ([*FLAGS, "--layout", LARGE], {"source.period_ms": 83}),  # that the bus carries
        (["--source", "can:can0"], {"source.kind": "can", "source.channel": "can0"}),
        (
            ["--source", "slcan:/dev/ttyACM0@3000000"],
            {"source.interface": "slcan", "source.channel": "/dev/ttyACM0@3000000"},
        ),
        (
            ["--source", "pcan:PCAN_USBBUS1"],
            {"source.kind": "can", "source.interface": "pcan", "source.channel": "PCAN_USBBUS1"},
        ),
        (
            ["--source", "serial:/dev/ttyACM0@115200"],
            {"source.kind": "serial", "source.channel": "/dev/ttyACM0@115200"},
        ),
        (
            ["--source", "array:ipc:///skin"],
            {"source.kind": "array", "source.endpoint": "ipc:///skin"},
        ),
        (["--source", "can:can0", "--bundle", "{thin}"], {"skin.full_scale_depth_m": 0.003}),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_configuration_is_written_from_options(
    tmp_path: Path, options: list[str], expected: dict[str, object]
) -> None:
    thin = box_of(tmp_path, r'"depth_max_m": [0-9.]+', '"depth_max_m": 0.003')
    printed("init", tmp_path / "skin.toml", *(option.format(thin=thin) for option in options))
    config = load(tmp_path / "skin.toml")
    assert {key: attrgetter(key)(config) for key in expected} == expected


def test_what_is_written_is_fine_and_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path, (ours, theirs) = tmp_path / "skin.toml", os.openpty()
    options = ["--source", f"slcan:{os.ttyname(theirs)}", *FLAGS[2:]]
    assert printed("init", path, *options).endswith(f"; next: taxeld check {path}\n")
    text = path.read_text(encoding="utf-8")
    assert "must stand upright, its axis within 0.1 rad of vertical" in text
    assert printed("check", path).startswith(f"{path}: fine")
    assert refused("init", path, *options).startswith(f"{path}: is there already and is not over")
    assert path.read_text(encoding="utf-8") == text
    for end in (ours, theirs):
        os.close(end)


def test_each_key_is_there_with_the_documented_words_and_its_default(tmp_path: Path) -> None:
    path = tmp_path / "skin.toml"
    printed("init", path, *FLAGS)
    text, tables = path.read_text(encoding="utf-8"), keys_of(Config)
    keys = [key for each in tables for key in keys_of(get_type_hints(Config)[each.name])]
    assert [key.name for key in keys if f"# {key.metadata['doc']}\n" not in text] == []
    bare = re.sub(r"^#(?! )", "", text, flags=re.MULTILINE)
    written = replace(parse(bare), is_sized=False)  # a written number of particles holds
    assert asdict(written) == asdict(parse(text)), "a default that is written is the code's"
    assert set(tomllib.loads(bare)) == {table.name for table in tables}


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (["--source", "usb0"], "--source: 'usb0' is no connection; use can:can0, slcan:"),
        (["--bundle", "n" * 5000], "scene.bundle: no bundle 'nnnn"),
        (["--layout", "cylinder:rowz=5"], "skin.layout: cylinder: rowz: unknown key; did you"),
        (["--source", ""], "--source: '' is no connection; use can:can0, slcan:"),
        (["--poses", "tcp://robot:1"], "sensor_pose.endpoint: 'tcp://robot:1' is not local"),
        (["--bundle", "{patch}"], "--layout: name the file of patch, for which "),
    ],
)
def test_an_option_that_cannot_be_used_is_one_line_and_nothing_is_written(
    tmp_path: Path, change: list[str], line: str
) -> None:
    patch = box_of(tmp_path, '"name": "cylinder:[^"]*"', '"name": "patch"')
    typed = (option.format(patch=patch) for option in change)
    assert refused("init", tmp_path / "skin.toml", *FLAGS, *typed).startswith(line)
    assert not (tmp_path / "skin.toml").exists()


def test_a_bundle_is_named_as_seen_from_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bracket").symlink_to(bundle.find("box"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    printed("init", "../skin.toml", *FLAGS, "--bundle", tmp_path / "bracket")
    assert '\nbundle = "bracket"\n' in (tmp_path / "skin.toml").read_text(encoding="utf-8")
