"""Every shipped scenario passes: on the fake clock all of them, over real transports a rough one.

With TAXELD_TARGET (`can:can0`, `serial:/dev/ttyACM0`, `slcan:/dev/ttyACM0`) the same files run on
hardware as well, with the robot's poses from TAXELD_POSES and the object at TAXELD_TRUTH ("x y θ"),
where these are set.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands.replay import Replay
from taxeld.estimator.estimate import Status
from taxeld.pipeline.freshness import Why
from taxeld.source.session import read_poses
from taxeld_hil.grade.session import read
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from tests.hil.rig import passing
from tests.rig.clocks import until

pytestmark = pytest.mark.check

HARNESS = [sys.executable, "-m", "taxeld_hil.cli"]
TARGET = os.environ.get("TAXELD_TARGET", "")

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
    truth = read_poses(tmp_path / "truth.csv")[0][1:]
    *_, last = Replay(tmp_path)
    assert last.estimate.status is Status.CONVERGED
    np.testing.assert_allclose(last.estimate.map[:2], truth[:2], atol=0.003)


def test_a_run_is_determined_by_its_seed() -> None:
    first, again, other = (
        FakeRun(scenario.load("corrupted").on("scene"), seed).graded("corrupted")
        for seed in (3, 3, 4)
    )
    assert first == again
    assert first.figures["ledger"] != other.figures["ledger"]


def cli(*args: str, limit_s: float = 300.0) -> "subprocess.CompletedProcess[str]":
    command = [*HARNESS, *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=limit_s, check=False)


@pytest.fixture(scope="module")
def rough(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rough scenario in real time over both kinds of pseudo-terminal, at the same time."""
    place = tmp_path_factory.mktemp("rough")
    runs = []
    for transport in ("slcan", "native"):
        out = place / transport
        file = place / f"{transport}.toml"
        file.write_text(f'transport = "{transport}"\n{ROUGH}', encoding="utf-8")
        command = ["run", str(file), "--out", str(out)]
        into = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        runs.append(subprocess.Popen([*HARNESS, *command], **into))
    for run in runs:
        printed, _ = run.communicate(timeout=300)
        assert run.returncode in (0, 1), printed
    return place


@pytest.mark.parametrize("transport", ["slcan", "native"])
def test_in_real_time_nothing_is_lost_without_being_counted(rough: Path, transport: str) -> None:
    """Through an unplugged device, a closed adapter and a daemon that was killed."""
    grade = json.loads((rough / transport / "grade.json").read_text(encoding="utf-8"))
    assert [law for law in grade["laws"] if not law["holds"]] == []
    assert grade["ledger"]["hosts"] == 2
    assert grade["ledger"]["fates"]["scans"] > 20  # since the last start, which may take seconds
    injected = [row for row in grade["faults"] if row["injected"]]
    assert len(injected) == (4 if transport == "slcan" else 3)  # the native link has no adapter
    for row in injected:
        assert row["detected_s"] is not None, row
        assert row["recovered_s"] is not None or row["overlapped"], row


def test_a_run_on_hardware_grades_what_it_can_and_names_what_it_cannot(tmp_path: Path) -> None:
    """The emulator stands in for the hardware, and serves until it is stopped."""
    (tmp_path / "s.toml").write_text(
        'bundle = "box"\nphysics = "scene"\ncontacts = 2\n'
        "expect = {found = false, recovery_s = 30.0}\n"
        '[[fault]]\nkind = "reboot"\nat_s = 1.0\n',
        encoding="utf-8",
    )
    skin_toml = 'bundle = "box"\nphysics = "scene"\ncontacts = 4\nrest_s = 600.0\n'
    (tmp_path / "skin.toml").write_text(skin_toml, encoding="utf-8")
    link, poses = tmp_path / "skin", f"ipc://{tmp_path}/poses"
    command = ["emulate", str(tmp_path / "skin.toml"), "--link", str(link), "--poses", poses]
    with subprocess.Popen([*HARNESS, *command, "--out", str(tmp_path / "session")]) as skin:
        try:
            until(link.exists)
            line = ["run", str(tmp_path / "s.toml"), "--target", f"slcan:{link}", "--poses", poses]
            done = cli(*line, "--out", str(tmp_path / "out"))
        finally:
            skin.kill()
    grade = json.loads((tmp_path / "out" / "grade.json").read_text(encoding="utf-8"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert grade["contacts"] >= 2
    checks = {check["name"]: check for check in grade["checks"]}
    assert checks["accounts"]["passed"] is None
    assert checks["nothing misleading"]["passed"] is None
    assert checks["reboot at 1 s: flag"]["detail"].startswith("not injected")


@pytest.mark.skipif(not TARGET, reason="TAXELD_TARGET names no hardware")
@pytest.mark.parametrize("name", [n for n in scenario.shipped() if scenario.load(n).links == 1])
def test_a_shipped_scenario_passes_on_hardware(name: str, tmp_path: Path) -> None:
    more = ["--poses", os.environ.get("TAXELD_POSES", "")]
    if "TAXELD_TRUTH" in os.environ:
        more += ["--truth", *os.environ["TAXELD_TRUTH"].split()]
    done = cli("run", name, "--target", TARGET, "--out", str(tmp_path), *more, limit_s=900.0)
    assert done.returncode == 0, done.stdout + done.stderr
