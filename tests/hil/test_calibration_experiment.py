"""The measurement of calibrations: what it sets up and remembers, and what it makes of runs."""

from collections import Counter

import numpy as np
import pytest

from taxeld.model import se2
from taxeld_hil.experiment import calibration as experiment
from taxeld_hil.experiment.measurement import RunRow
from taxeld_hil.rig.rig import Rig
from taxeld_hil.world import calibration_touches
from tests.hil.rig import DEMO, MODEL, TRUTH

TYPICAL = DEMO.on("typical")


def test_a_calibration_presses_with_every_side_of_the_skin_and_from_all_around() -> None:
    plan = calibration_touches.plan(MODEL, TRUTH, seed=3, presses=20)
    assert len(plan.touches) == 20
    assert plan.touches[0].begin_s > calibration_touches.IDLE_S
    felt, around = set(), set()
    for touch in plan.touches:
        sensor = plan.path.at(float(np.mean(touch.held_s)))
        h = MODEL.activation(se2.compose(se2.inverse(sensor), TRUTH)[None])[0]
        assert h.max() > 0.1
        column = int(h.argmax()) % 16
        felt.add(column // 2)
        away = sensor[:2] - TRUTH[:2]
        around.add(int(np.arctan2(away[1], away[0]) // (np.pi / 2)))
    assert len(felt) >= 7  # of eight
    assert len(around) == 4


def test_a_robot_with_a_mount_tells_of_another_frame_than_the_sensors() -> None:
    mount = np.array([0.01, -0.02, 0.4])
    straight, bent = Rig(TYPICAL, 0), Rig(TYPICAL, 0)
    experiment.mounted(bent, mount)
    (true,), (told,) = straight.poses(5.0, 5.0, 5.0), bent.poses(5.0, 5.0, 5.0)
    assert told[0] == true[0]
    assert se2.compose(np.array(told[1:]), mount) == pytest.approx(np.array(true[1:]))


def test_modules_that_are_swapped_read_each_others_taxels_and_nothing_else_changes() -> None:
    rig, usual = Rig(TYPICAL, 0), Rig(TYPICAL, 0)
    experiment.swapped(rig, 2, 3)
    before, after = usual.world.channels, rig.world.channels
    for module in range(8):
        other = {2: 3, 3: 2}.get(module, module)
        assert (
            after.taxel[after.module == module].tolist()
            == before.taxel[before.module == other].tolist()
        )


def test_a_wrong_full_scale_is_noticed_and_a_right_one_is_not() -> None:
    touch, suspect = experiment.noticed(TYPICAL, 0, 7, factor=2.5)
    assert suspect == "scale"
    assert 5 <= touch <= 7
    assert experiment.noticed(TYPICAL, 0, 7) == (0, "")


def run(sort: str, seed: int = 0) -> RunRow:
    """A run as it is saved."""
    about: RunRow = {"sort": sort, "object": "box", "skin": "typical", "seed": seed}
    if sort == "find":
        one = {"gains_known": 40, "gain_off": 0.02, "mount_off_mm": 0.1, "yaw_off_deg": 0.05}
        return {**about, "given": one, "found": {"refused": "calibrate: why"}}
    if sort == "buy":
        errors = {"without": [3, 2, 1], "without, mount off": [4, 3, 2], "with": [1, 0.5, 0.25]}
        return {**about, **errors}
    return {**about, "noticed_after": 0 if sort == "none" else 6 + seed, "suspect": "scale"}


def test_a_measurement_has_more_runs_where_nothing_is_wrong() -> None:
    sorts = Counter(job.arguments[0] for job in experiment.jobs(("typical",), 2))
    assert sorts.pop("none") == 2 * experiment.RIGHT * 2, "of a box and a mug"
    assert sorts.keys() == {"find", "buy", *experiment.FAULTS} - {"none"}
    assert set(sorts.values()) == {2}


def test_the_tables_are_of_the_runs() -> None:
    fault = next(name for name in experiment.FAULTS if name != "none")
    faults = [run(fault, seed) for seed in range(4)]
    table = list(experiment.lines([run("find"), run("buy"), run("none"), *faults]))
    assert "| typical, found | 1, 1 | | | | |" in table
    assert any(line.startswith("| typical, given | 1, 0 | 40 | 2.0% (2.0%)") for line in table)
    assert table[-1] == f"| {fault} | typical, box | 4 | 4 | 3 | 4 scale |"
