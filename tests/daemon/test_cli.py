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
from operator import attrgetter
from pathlib import Path
from typing import Any, get_type_hints

import pytest

from taxeld.commands.status import lines
from taxeld.config.file import load, parse
from taxeld.config.gate import keys_of
from taxeld.config.tables import Config, SkinConfig
from taxeld.estimator.estimate import Status
from taxeld.pipeline.freshness import CURES, Why
from taxeld.proposals import bundle
from taxeld.stream import client
from tests import pages
from tests.rig.clocks import until
from tests.rig.commands import printed, refused
from tests.rig.configurations import Table, configuration
from tests.rig.processes import taxeld
from tests.rig.recorded import LiveSkin, golden, write_golden
from tests.rig.stream_page import ROOT, documented

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


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The place of a daemon whose skin is touched again and again."""
    place = tmp_path_factory.mktemp("daemon")
    with (
        LiveSkin(place, touches=40) as skin,
        taxeld("run", configuration(place, source=skin.source)) as daemon,
    ):
        try:
            until(lambda: client.ask(f"ipc://{place}/control", "info", timeout_s=0.5))
            until(lambda: _status(place)["estimate"]["contacts"])
            until(lambda: _status(place)["health"].get("dead_taxels"))
            yield place
        finally:
            daemon.terminate()
    assert daemon.returncode == 0


def _status(place: Path) -> dict[str, Any]:
    return client.ask(f"ipc://{place}/control", "status", timeout_s=20.0)  # type: ignore[return-value]


def test_status_is_aligned_names_and_values_with_units(running: Path) -> None:
    said = printed("status", running / "config.toml").splitlines()
    rows = dict(line.split(": ", maxsplit=1) for line in said)
    assert {len(name) for name in rows} == {14}
    values = {name.strip(): value for name, value in rows.items()}
    assert (values["Dead taxels"], "Bus" in values) == ("1 (4)", False)
    assert re.match(r"\d+,", values["Contacts"])
    assert re.match("median .* max", values["Total time"])
    answer = json.loads(printed("status", f"ipc://{running}/control", "--json"))
    assert set(answer) == {"ok", "estimate", "health", "waits_for", "why", "sensor_pose"}


def test_reset_tare_and_prior_wait_for_the_answer_and_say_what_happened(running: Path) -> None:
    config = running / "config.toml"
    assert _status(running)["estimate"]["contacts"] > 0
    assert printed("reset", config) == "all touches are forgotten\n"
    assert "leave the skin untouched" in printed("tare", config)
    assert "is taken" in printed("prior", config, "--at", "-0.1", "0", "nan")
    told = refused("prior", config, "--at", "99", "0", "0", status=1)
    assert told.startswith(f"ipc://{running}/control: prior: x: must be -10..10 m")


@pytest.mark.parametrize(
    ("keys", "endpoint", "status", "line"),
    [
        ("", "ipc://{place}/control", 1, "no daemon answers at {at}; is 'taxeld run' there?\n"),
        ("", "tcp://robot:1", 2, "endpoint: '{at}' is not local; use ipc:///path or tcp://127"),
        ("", "robot", 2, "robot: unreadable configuration"),
        ("/nowhere", "tcp://robot:1", 2, "TAXELD_KEYS: /nowhere/client.key_secret cannot be read"),
    ],
)
def test_a_daemon_that_cannot_be_asked_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: str,
    endpoint: str,
    status: int,
    line: str,
) -> None:
    monkeypatch.setattr(client, "TIMEOUT_S", 0.1)
    monkeypatch.setenv("TAXELD_KEYS", keys)
    at = endpoint.format(place=tmp_path)
    assert refused("tare", at, status=status).startswith(line.format(at=at))


def test_status_begins_as_the_page_of_a_first_robot_shows() -> None:
    page = (ROOT / "docs" / "first-robot.md").read_text(encoding="utf-8")
    [shown] = [text for language, text in pages.FENCED.findall(page) if language == "text"]
    of_one = {"status": Status.CONVERGED, "objects": {"bracket": 1.0, "other": 0.0}}
    said = "\n".join(lines({"estimate": ESTIMATE | of_one}))
    assert pages.NUMBER.sub("N", said).startswith(pages.NUMBER.sub("N", shown))


ESTIMATE, HEALTH = (documented(f"/taxeld/{name}")[1] for name in ("estimate", "health"))
ABSENT = "source.channel: cannot open /dev/skin (it is not there; is it plugged in?)"
LOOK_AT_POSES = "the sensor's pose: docs/troubleshooting.md#the-sensors-pose-is-missing"
OTHER_TOO = {"stands": 0.7, "moved": 0.1, "other": 0.2}
NOT_VALID = "Not valid     : "


def with_health(**keys: Any) -> dict[str, Any]:
    return {"estimate": ESTIMATE, "health": HEALTH | keys}


def with_poses(**keys: str) -> dict[str, Any]:
    return with_health() | {"sensor_pose": {"endpoint": "", "fault": ""} | keys}


TIMING = {"poses_rate_hz": 100.0, "poses_age_s": 0.01}
LATE = "Pose timing   : 100 a second, the last 0.01 s ago, their time 4.2 s"


def with_estimate(**keys: Any) -> dict[str, Any]:
    return {"estimate": ESTIMATE | keys}


SAID: list[tuple[dict[str, Any], str]] = [  # an answer, and a line of its text, or a part of it
    (with_health() | {"waits_for": ABSENT}, f"Device        : waiting, {ABSENT}\n"),
    (with_health(calibration={"age_s": 2.5 * 86_400.0}), "Calibration   : 2.5 days old\n"),
    (with_health(), "Calibration   : none; full scale and mount are"),
    *(
        (with_health(source=HEALTH["source"] | {"bus": {"no_ack": 12, "unread": 3}}), told)
        for told in ("Bus           : no_ack 12 (nothing ackn", "; unread 3 (the kernel dropped")
    ),
    (with_health(estimator={"jumps": 3}), f"Not 0         : estimator.jumps 3: {LOOK_AT_POSES}\n"),
    *(
        (with_health(), f"Not 0         : {name}_taxels {first}: mend them; taxeld tare\n")
        for name, first in (("stuck", 17), ("saturated", 30), ("untared", 4))
    ),
    (with_health(), "Sensor poses  : 500 used\n"),  # as before the first health
    (with_poses(), "Sensor poses  : sensor_pose.endpoint is empty: the sensor stands still\n"),
    (with_poses(endpoint="tcp://a:1"), "Sensor poses  : 500 used, from tcp://a:1\n"),
    (with_poses(endpoint="tcp://a:1", fault="none comes"), "Pose fault    : none comes\n"),
    *(
        (with_health(inputs=HEALTH["inputs"] | TIMING | {"poses_offset_s": offset_s}), told)
        for offset_s, told in (
            (4.2, f"{LATE} behind this clock\n"),
            (-4.2, f"{LATE} ahead of this"),
        )
    ),
    (with_estimate(status=99) | {"health": {}}, "Status        : unknown (99), valid\n"),
    (
        with_estimate(p=0.6, hypotheses=OTHER_TOO),
        "p 60.0%, radius 8.8 mm; stands 70%, moved 10%, other 20%\n",
    ),
    (
        with_estimate(p=0.5, status=Status.AMBIGUOUS),
        "Certainty     : p 50.0%, radius 8.8 mm; touch another side\n",
    ),
    *(
        (with_estimate(valid=False, why=int(why)), f"{NOT_VALID}{CURES[why]}\n")
        for why in Why
        if why is not Why.VALID
    ),
    # of a newer daemon; and with a fact, by the daemon itself
    (with_estimate(valid=False, why=99), f"{NOT_VALID}unknown (99)\n"),
    (with_estimate(valid=False, why=8) | {"why": "it seems to be at"}, f"{NOT_VALID}it seems to"),
]


@pytest.mark.parametrize(("answer", "told"), SAID, ids=[told[:40] for _, told in SAID])
def test_an_answer_becomes_lines_that_name_what_is_to_be_done(
    answer: dict[str, Any], told: str
) -> None:
    said = "".join(f"{line}\n" for line in lines(answer))
    assert told in said
    assert (NOT_VALID in said) != answer["estimate"]["valid"]
