"""Commands: what they print, and one clear line with exit status 2 for whatever is wrong."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

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
    ("filter", "proposal", "ddpm-7", "filter.proposal: box has no 'ddpm-7'; it has auto, "),
    ("curve", "directory", "/nowhere", "curve.directory: /nowhere/server.key_secret is not"),
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
