"""The measurement of calibrations: what it sets up and remembers, and what it makes of runs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.proposals import bundle
from taxeld_hil import cli
from taxeld_hil.experiment import calibration_experiment as experiment
from taxeld_hil.experiment import calibration_runs as runs
from taxeld_hil.experiment.calibration_experiment import FAULTS, Case, Plan, lines
from taxeld_hil.rig.rig import Rig
from taxeld_hil.scenario import scenario
from taxeld_hil.world import calibration_touches

DEMO = scenario.load("demo").on("typical")
SKIN = layouts.load(DEMO.layout)
TRUTH = np.array([0.05, -0.1, 0.7])


def test_a_calibration_presses_with_every_side_of_the_skin_and_from_all_around() -> None:
    model = bundle.load("box", SKIN, 0.005).model
    plan = calibration_touches.plan(model, TRUTH, seed=3, presses=20)
    assert len(plan.touches) == 20
    assert plan.touches[0].begin_s > calibration_touches.IDLE_S
    felt, around = set(), set()
    for touch in plan.touches:
        sensor = plan.path.at(float(np.mean(touch.held_s)))
        h = model.activation(se2.compose(se2.inverse(sensor), TRUTH)[None])[0]
        assert h.max() > 0.1
        column = int(h.argmax()) % 16
        felt.add(column // 2)
        away = sensor[:2] - TRUTH[:2]
        around.add(int(np.arctan2(away[1], away[0]) // (np.pi / 2)))
    assert len(felt) >= 7  # of eight
    assert len(around) == 4


def test_a_robot_with_a_mount_tells_of_another_frame_than_the_sensors() -> None:
    mount = np.array([0.01, -0.02, 0.4])
    straight, bent = Rig(DEMO, 0), Rig(DEMO, 0)
    runs.mounted(bent, mount)
    (true,), (told,) = straight.poses(5.0, 5.0, 5.0), bent.poses(5.0, 5.0, 5.0)
    assert told[0] == true[0]
    assert se2.compose(np.array(told[1:]), mount) == pytest.approx(np.array(true[1:]))


def test_modules_that_are_swapped_read_each_others_taxels_and_nothing_else_changes() -> None:
    rig, usual = Rig(DEMO, 0), Rig(DEMO, 0)
    runs.swapped(rig, 2, 3)
    before, after = usual.world.channels, rig.world.channels
    for module in range(8):
        other = {2: 3, 3: 2}.get(module, module)
        assert (
            after.taxel[after.module == module].tolist()
            == before.taxel[before.module == other].tolist()
        )


def test_a_wrong_full_scale_is_noticed_and_a_right_one_is_not() -> None:
    touch, suspect = runs.noticed(DEMO, 0, 7, factor=2.5)
    assert suspect == "scale"
    assert 5 <= touch <= 7
    assert runs.noticed(DEMO, 0, 7) == (0, "")


def found(case: Case) -> dict[str, Any]:
    if case.sort == "find":
        one = {"gains_known": 40, "gain_off": 0.02, "mount_off_mm": 0.1, "yaw_off_deg": 0.05}
        return {"given": one, "found": {"refused": "calibrate: why"}}
    if case.sort == "buy":
        return {"without": [3, 2, 1], "without, mount off": [4, 3, 2], "with": [1, 0.5, 0.25]}
    return {"noticed_after": 0 if case.sort == "none" else 6 + case.seed, "suspect": "scale"}


def test_runs_are_remembered_and_a_measurement_that_was_cut_short_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played: list[Case] = []

    def play(case: Case, code: str) -> dict[str, Any]:
        assert code == "this code"
        played.append(case)
        if len(played) == 5:
            raise KeyboardInterrupt
        return found(case)

    monkeypatch.setattr(experiment, "play", play)
    monkeypatch.setattr(experiment, "solid_of", lambda *_: None)
    monkeypatch.setattr(experiment, "digest", lambda _: "this code")
    plan, memory = Plan(skins=("typical",), seeds=1, right_seeds=1), tmp_path / "memory"
    with pytest.raises(KeyboardInterrupt):
        experiment.experiment(plan, tmp_path, memory, 1)
    path = experiment.experiment(plan, tmp_path, memory, 1)
    assert len(played) == len(plan.cases()) + 1
    assert len(json.loads(path.read_text())["runs"]) == len(plan.cases())
    table = list(lines(path))
    assert "| typical, found | 1, 1 | | | | |" in table
    assert any(line.startswith("| typical, given | 1, 0 | 40 | 2.0% (2.0%)") for line in table)


def test_the_table_counts_doubts_and_those_within_eight_touches(tmp_path: Path) -> None:
    fault = next(name for name in FAULTS if name != "none")
    cases = [Case(fault, "box", "typical", seed) for seed in range(4)]
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"runs": [{**case._asdict(), **found(case)} for case in cases]}))
    assert list(lines(path))[-1] == f"| {fault} | typical, box | 4 | 4 | 3 | 4 scale |"


def test_a_skin_without_depths_of_its_own_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["calibration", "--skin", "scene", "--out", str(tmp_path)]) == 2
    assert "--skin scene: is no soft skin" in capsys.readouterr().err
    assert cli.main(["calibration"]) == 2
    assert "--out: is required" in capsys.readouterr().err
