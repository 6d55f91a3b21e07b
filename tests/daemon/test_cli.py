"""Commands: what they print and write, and one clear line with status 2 for whatever is wrong."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import get_type_hints

import pytest

from taxeld.commands.init import connection
from taxeld.config.file import load, parse
from taxeld.config.gate import keys_of
from taxeld.config.tables import Config, SkinConfig, SourceConfig
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld.source.sources import live
from tests.rig.commands import printed, refused
from tests.rig.recorded import golden, write_golden

from ..firmware_protocol.test_cyskin import GOLDEN_SCAN

DECLARED = "501#3C0301000C8C"  # one module of 12 channels


@pytest.fixture
def place(tmp_path: Path) -> Path:
    write_golden(tmp_path)
    return tmp_path


def test_decode_loses_only_what_is_damaged_and_counts_every_frame(tmp_path: Path) -> None:
    damage = [
        "101#431A0000",  # half a packet, cut short by the next first fragment
        *GOLDEN_SCAN,
        "201#0011223344556677",  # orphan
        *GOLDEN_SCAN[:3],
        "401#271A271BAA",  # wrong CRC
        "777#00",
        "18DAF110#0102",
        "not a frame",
        *GOLDEN_SCAN,
        DECLARED,
    ]
    log = tmp_path / "damaged.log"
    log.write_text("\n".join(damage) + "\n(17000", encoding="ascii")
    *scans, last = map(json.loads, printed("decode", log).splitlines())
    stats = last["stats"]
    assert [scan["modules"][0] for scan in scans] == [list(range(10000, 10012))] * 2
    assert stats["frames"] == 17
    assert stats["frames"] == stats["used"] + sum(stats["dropped"].values()) + stats["pending"]
    assert stats["dropped"] == {"crc": 4, "length": 1, "orphan": 1, "foreign": 2}
    assert (stats["crc_errors"], stats["length_errors"], stats["unknown"]) == (1, 1, 2)
    assert stats["bad_lines"] == 2


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


def test_check_passes_what_is_fine_and_a_fault_is_one_line_and_status_2(place: Path) -> None:
    path = golden(place)
    assert printed("check", path) == f"{path}: fine\n"
    for table, key, value, line in FAULTS:
        path = golden(place, **{table: {key: value}})
        assert refused("check", path).startswith(line)
        if table in ("source", "scene"):
            assert refused("run", path).startswith(line)


@pytest.mark.parametrize("command", ["check", "decode", "replay", "status", "advise", "calibrate"])
def test_a_missing_file_is_one_line_and_status_2(command: str) -> None:
    more = ["--check"] if command == "calibrate" else []
    assert "nowhere" in refused(command, "/nowhere.toml", *more)


def test_a_session_that_is_none_or_damaged_or_whose_files_stayed_elsewhere_says_so(
    place: Path,
) -> None:
    for directory in (place / "none", place):
        assert refused("replay", directory).startswith(f"{directory}: is no session (it has no ")
    golden(place)
    (place / "frames.log").write_text("(1.0) can0 101#43\n(1.0) can\n", encoding="ascii")
    assert "line 2 is no candump line" in refused("replay", place)
    for table, key, value in (
        ("scene", "bundle", "objects/bracket"),
        ("skin", "layout", "skin.json"),
    ):
        golden(place, **{table: {key: value}})
        told = refused("replay", place)
        assert told.startswith(f"{table}.{key}: ")
        assert told.endswith(
            "; a session does not hold its layout and its bundle: name them in "
            f"{place}/config.toml, by whole paths, or in another file with --config\n"
        )


def test_decode_into_a_closed_pipe_ends_quietly(tmp_path: Path) -> None:
    log = tmp_path / "long.log"
    log.write_text("\n".join([DECLARED, *GOLDEN_SCAN * 5000]) + "\n", encoding="ascii")
    ran = subprocess.run(
        f"{sys.executable} -m taxeld.cli decode {log} | head -n 1",
        shell=True,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.stderr == ""
    assert ran.stdout.startswith('{"t":0.0')


FLAGS = ["--source", "slcan:{device}", "--bundle", "box", "--poses", "tcp://127.0.0.1:9874"]


@pytest.fixture
def flags(tmp_path: Path) -> Iterator[list[str]]:
    ours, theirs = os.openpty()
    (tmp_path / "ttyACM0").symlink_to(os.ttyname(theirs))
    yield [flag.format(device=tmp_path / "ttyACM0") for flag in FLAGS]
    os.close(ours)
    os.close(theirs)


def test_what_is_written_from_options_is_fine(
    tmp_path: Path, flags: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = tmp_path / "skin.toml"
    assert printed("init", path, *flags).endswith(f"; next: taxeld check {path}\n")
    assert printed("check", path).startswith(f"{path}: fine")
    assert "must stand upright, its axis within 0.1 rad of vertical" in path.read_text()
    config = parse(path.read_text(encoding="utf-8"))
    assert (config.source.kind, config.source.interface) == ("can", "slcan")
    assert config.source.channel == str(tmp_path / "ttyACM0")
    assert config.sensor_pose.endpoint == "tcp://127.0.0.1:9874"


def test_an_array_and_a_skin_without_an_object_have_a_configuration(tmp_path: Path) -> None:
    array, alone = tmp_path / "array.toml", tmp_path / "alone.toml"
    printed("init", array, *FLAGS[2:4], "--source", "array:ipc:///skin", "--poses", "")
    source = load(array).source
    assert (source.kind, source.endpoint) == ("array", "ipc:///skin")
    layout = SkinConfig().layout
    printed("init", alone, "--source", "can:can0", "--layout", layout)
    assert (load(alone).scene.names, load(alone).skin.layout) == ((), layout)


def test_a_skin_too_large_for_the_usual_period_gets_one_that_the_bus_carries(
    tmp_path: Path, flags: list[str]
) -> None:
    path = tmp_path / "large.toml"
    large = "cylinder:rows=31,columns=80,radius_m=0.2,pitch_m=0.015"
    printed("init", path, *flags, "--layout", large)
    config = parse(path.read_text(encoding="utf-8"))
    assert config.source.period_ms == 83
    live(config.source, layouts.load(large))


def test_the_depth_is_that_of_the_bundle(tmp_path: Path) -> None:
    box = Path(shutil.copytree(bundle.find("box"), tmp_path / "box")) / "bundle.json"
    box.write_text(re.sub(r'"depth_max_m": [0-9.]+', '"depth_max_m": 0.003', box.read_text()))
    written = tmp_path / "skin.toml"
    printed("init", written, "--source", "can:can0", "--bundle", box.parent)
    config = load(written)
    assert config.skin.full_scale_depth_m == 0.003
    loaded = bundle.load(config.scene.bundle, layouts.load(config.skin.layout), 0.003)
    assert loaded.model.depth_max_m == 0.003


def test_each_key_is_there_with_the_documented_words_and_its_default(
    tmp_path: Path, flags: list[str]
) -> None:
    path = tmp_path / "skin.toml"
    printed("init", path, *flags)
    text = path.read_text(encoding="utf-8")
    tables = keys_of(Config)
    for table in tables:
        for key in keys_of(get_type_hints(Config)[table.name]):
            assert f"# {key.metadata['doc']}\n" in text, (table.name, key.name)
    bare = "\n".join(
        line.removeprefix("#") if line.startswith("#") and line[1:2] != " " else line
        for line in text.splitlines()
    )
    written = replace(parse(bare), is_sized=False)  # a written number of particles holds
    assert asdict(written) == asdict(parse(text)), "a default that is written is the code's"
    assert set(tomllib.loads(bare)) == {table.name for table in tables}


def test_a_file_that_is_there_is_not_overwritten(tmp_path: Path, flags: list[str]) -> None:
    path = tmp_path / "skin.toml"
    path.write_text("mine", encoding="utf-8")
    assert refused("init", path, *flags).startswith(
        f"{path}: is there already and is not overwritten"
    )
    assert path.read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("can:can0", ("can", "socketcan", "can0")),
        ("slcan:/dev/ttyACM0@3000000", ("can", "slcan", "/dev/ttyACM0@3000000")),
        ("pcan:PCAN_USBBUS1", ("can", "pcan", "PCAN_USBBUS1")),
        ("serial:/dev/ttyACM0@115200", ("serial", "socketcan", "/dev/ttyACM0@115200")),
    ],
)
def test_a_connection_is_one_of_the_daemons_sources(text: str, keys: tuple[str, ...]) -> None:
    found = SourceConfig(**connection(text, "TARGET"))
    assert (found.kind, found.interface, found.channel) == keys


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (["--source", "usb0"], "--source: 'usb0' is no connection; use can:can0, slcan:"),
        (["--bundle", "n" * 5000], "scene.bundle: no bundle 'nnnn"),
        (["--layout", "cylinder:rowz=5"], "skin.layout: cylinder: rowz: unknown key; did you"),
        (["--source", ""], "--source: '' is no connection; use can:can0, slcan:"),
        (["--poses", "tcp://robot:1"], "sensor_pose.endpoint: 'tcp://robot:1' is not local"),
    ],
)
def test_an_option_that_cannot_be_used_is_one_line_and_nothing_is_written(
    tmp_path: Path, flags: list[str], change: list[str], line: str
) -> None:
    path = tmp_path / "skin.toml"
    assert refused("init", path, *flags, *change).startswith(line)
    assert not path.exists()


def test_the_layout_of_a_bundle_that_was_built_for_a_file_is_to_be_named(
    tmp_path: Path, flags: list[str]
) -> None:
    box = Path(shutil.copytree(bundle.find("box"), tmp_path / "box")) / "bundle.json"
    box.write_text(re.sub(r'"name": "cylinder:[^"]*"', '"name": "patch"', box.read_text()))
    line = refused("init", tmp_path / "skin.toml", *flags, "--bundle", box.parent)
    assert line.startswith("--layout: name the file of patch, for which ")


def test_a_bundle_is_named_as_seen_from_the_configuration(
    tmp_path: Path, flags: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bracket").symlink_to(bundle.find("box"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    printed("init", "../skin.toml", *flags, "--bundle", tmp_path / "bracket")
    assert '\nbundle = "bracket"\n' in (tmp_path / "skin.toml").read_text(encoding="utf-8")
