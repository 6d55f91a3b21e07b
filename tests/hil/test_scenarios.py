"""Every shipped scenario passes, on the fake clock; over real transports a rough one does."""

import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands.replay import Replay
from taxeld.estimator.estimate import Status
from taxeld.pipeline.freshness import Why
from taxeld.source.session import truth
from taxeld_hil import cli
from taxeld_hil.grade.session import read
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from tests.hil.rig import passing
from tests.rig.clocks import until

pytestmark = pytest.mark.check

TOUCHED_S = 30.0  # until six contacts are made, with a start
HARNESS = [sys.executable, "-m", "taxeld_hil.cli"]

ROUGH = """\
bundle = "box"
physics = "scene"
contacts = 4
expect = {found = false, recovery_s = 15.0}
fault = [
    {kind = "corrupted", at_s = 2.0, for_s = 3.0},
    {kind = "unplugged", at_s = 6.0, for_s = 2.0},
    {kind = "adapter_closed", at_s = 9.0, for_s = 0.1},
    {kind = "daemon_killed", at_s = 12.0, for_s = 0.5},
]
"""


def test_no_estimate_is_valid_before_a_touch_has_told_something(tmp_path: Path) -> None:
    """The first scans of a touch are felt before the belief has learned from them."""
    FakeRun(replace(scenario.load("demo"), contacts=1), 0).graded("demo", tmp_path)
    e = read(tmp_path, 1).estimates
    assert set(e.why[(e.status == Status.SEARCHING) & (e.contacts > 0)]) == {Why.VAGUE}
    assert Why.VALID in e.why


def shipped(name: str, foam: str, transport: str = "") -> Scenario:
    return scenario.load(name).over(transport).on(foam)


RECOVERIES = [
    f"{fault.kind} at {fault.at_s:g} s: recovery" for fault in scenario.load("everything").fault
]
POOR = ("object found", "accuracy")  # there little is found, and nothing is claimed
CASES = [  # a scenario, its foam and its transport, and the checks that are left to luck
    *((name, "scene", "", ()) for name in scenario.shipped()),
    ("demo", "typical", "", ()),
    ("pose_frozen", "typical", "", ()),
    ("module_dead", "poor", "", (*POOR, "module_dead at")),
    ("unplugged", "poor", "", (*POOR, "unplugged at")),
    # whatever the estimate is worth there, nothing is lost and every fault shows
    ("everything", "poor", "", (*POOR, "nothing misleading", *RECOVERIES)),
    ("everything", "scene", "native", ()),
    ("everything", "scene", "array", ()),
    ("damaged_line", "scene", "can", ()),
]


@pytest.mark.parametrize(("name", "foam", "transport", "luck"), CASES)
def test_a_shipped_scenario_passes_on_any_foam_and_transport(
    name: str, foam: str, transport: str, luck: tuple[str, ...]
) -> None:
    run, _ = passing(shipped(name, foam, transport), luck=luck)
    assert run.rig.ledger.fates.scans > 100


def test_few_touches_that_are_advised_find_the_object() -> None:
    run, _ = passing(replace(scenario.load("demo"), advised=True, contacts=4))
    assert len(run.rig.world.touched_s()) <= 4


@pytest.mark.smoke
@pytest.mark.parametrize("transport", ["slcan", "native", "array"])
def test_a_run_on_the_fake_clock_leaves_a_session_that_replays_to_its_end(
    transport: str, tmp_path: Path
) -> None:
    passing(shipped("demo", "scene", transport), tmp_path)
    *_, last = Replay(tmp_path)
    assert last.estimate.status is Status.CONVERGED
    np.testing.assert_allclose(last.estimate.map[:2], truth(tmp_path)[:2], atol=0.003)


def test_a_run_is_determined_by_its_seed() -> None:
    first, again, other = (
        FakeRun(scenario.load("corrupted").on("scene"), seed).graded("corrupted")
        for seed in (3, 3, 4)
    )
    assert first == again
    assert first.figures["ledger"] != other.figures["ledger"]


@pytest.fixture(scope="module")
def in_real_time(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rough scenario over both kinds of pseudo-terminal and a minute of drawn faults, at the same
    time."""
    place = tmp_path_factory.mktemp("rough")
    runs = {"drawn": ["demo", "--foam", "scene", "--random", "1", "--seed", "35"]}
    for transport in ("slcan", "native"):
        file = place / f"{transport}.toml"
        file.write_text(f'transport = "{transport}"\n{ROUGH}', encoding="utf-8")
        runs[transport] = [str(file)]
    into = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    begun = [
        subprocess.Popen([*HARNESS, "run", *asked, "--out", str(place / name)], **into)
        for name, asked in runs.items()
    ]
    for run in begun:
        printed, _ = run.communicate(timeout=300)
        assert run.returncode in (0, 1), printed
    return place


# the native link has no adapter; a drawn minute has no daemon that is killed
@pytest.mark.parametrize(
    ("name", "faults", "lives"), [("slcan", 4, 2), ("native", 3, 2), ("drawn", 3, 1)]
)
def test_in_real_time_nothing_is_lost_without_being_counted(
    in_real_time: Path, name: str, faults: int, lives: int
) -> None:
    """Through an unplugged device, a closed adapter and a daemon that was killed."""
    grade = json.loads((in_real_time / name / "grade.json").read_text(encoding="utf-8"))
    assert [law for law in grade["laws"] if not law["holds"]] == []
    assert grade["ledger"]["hosts"] == lives
    assert grade["ledger"]["fates"]["scans"] > 20  # since the last start, which may take seconds
    injected = [row for row in grade["faults"] if row["injected"]]
    assert len(injected) == faults
    for row in injected:
        assert row["detected_s"] is not None, row
        assert name == "drawn" or row["recovered_s"] is not None or row["overlapped"], row


def test_what_was_recorded_on_hardware_is_graded_by_its_replay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The emulator stands in for the hardware, and serves until it is stopped; its robot falls
    silent first."""
    skin_toml = (
        'bundle = "box"\nphysics = "scene"\ncontacts = 6\nrest_s = 600.0\n'
        'fault = [{kind = "pose_silent", at_s = 25.0, for_s = 500.0}]\n'
    )
    (tmp_path / "skin.toml").write_text(skin_toml, encoding="utf-8")
    link, poses = tmp_path / "skin", f"ipc://{tmp_path}/poses"
    emulate = ["emulate", str(tmp_path / "skin.toml"), "--link", str(link), "--poses", poses]
    config, session = tmp_path / "robot.toml", tmp_path / "touches"
    config.write_text(
        f'[source]\nkind = "can"\ninterface = "slcan"\nchannel = "{link}"\n'
        f'[scene]\nbundle = "box"\n[sensor_pose]\nendpoint = "{poses}"\n',
        encoding="utf-8",
    )
    record = [sys.executable, "-m", "taxeld.cli", "record", "--out", str(session), str(config)]
    with subprocess.Popen([*HARNESS, *emulate, "--out", str(tmp_path / "emulated")]) as skin:
        try:
            until(link.exists)
            with subprocess.Popen(record) as recorder:
                time.sleep(TOUCHED_S)
                recorder.send_signal(signal.SIGINT)
        finally:
            skin.kill()
    truth = (tmp_path / "emulated" / "truth.csv").read_text(encoding="ascii").split(",")[-3:]
    assert cli.main(["grade", str(session), "--truth", *truth]) == 0
    graded = capsys.readouterr().out
    assert "ok    object found: status converged" in graded
    assert "ok    nothing misleading: 0 of " in graded
    assert "not graded: only a virtual skin keeps a ledger" in graded
    x, y, theta = map(float, truth)
    assert cli.main(["grade", str(session), "--truth", f"{x + 0.05}", f"{y}", f"{theta}"]) == 1
    assert re.search(r"FAIL  accuracy: (49|50)\.", capsys.readouterr().out)
    assert cli.main(["grade", str(session)]) == 0
    assert "not graded: the true pose is not known" in capsys.readouterr().out
