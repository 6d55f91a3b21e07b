"""Many runs, as jobs: scenarios on objects and skins, and random faults; and the words that their
estimates are judged by."""

import json
import math
import shutil
from importlib import resources
from itertools import pairwise
from pathlib import Path

import pytest

from taxeld.estimator.estimate import SURE
from taxeld.layout import read as layouts
from taxeld_hil import cli
from taxeld_hil.experiment import runs
from taxeld_hil.scenario import random_faults
from taxeld_hil.scenario.scenario import Scenario
from taxeld_sim import integrity
from taxeld_sim.trials import case
from tests.hil.rig import DEMO, SKIN
from tests.rig.skins import table_of

SMALL = "cylinder:rows=2,columns=20,radius_m=0.04,pitch_m=0.015"  # four modules of ten taxels
SHORT = """\
bundle = "box"
contacts = 3
expect = {found = false}
fault = [{kind = "flooded", at_s = 2.0}]
"""


def test_a_run_of_other_code_or_another_scenario_bundle_or_layout_is_not_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy, own = tmp_path / "box", tmp_path / "own.csv"
    shutil.copytree(Path(str(resources.files("taxeld") / "bundles" / "box")), copy)

    def code(subject: Scenario = DEMO) -> str:
        return runs.of("demo", subject, 0).code

    codes = [code(), code(DEMO.on("poor")), code(DEMO.touching(str(copy)))]
    with (copy / "bundle.json").open("a") as file:
        file.write("\n")
    codes.append(code(DEMO.touching(str(copy))))
    for layout in (SKIN, layouts.load("wrap:modules=12,radius_m=0.04")):
        own.write_text(table_of(layout), encoding="ascii")
        codes.append(code(DEMO.on("", str(own))))
    assert code() == codes[0]
    monkeypatch.setattr(case, "code", lambda: "of other code")
    assert len({*codes, code()}) == 7


def test_a_measurement_goes_on_from_what_it_remembers_and_names_the_checks_that_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    short = tmp_path / "short.toml"
    short.write_text(SHORT, encoding="utf-8")
    command = ["matrix", str(short), "--foam", "stiff", "--object", "box", "--workers", "1"]
    command += ["--out", str(tmp_path)]
    assert cli.main([*command, "--seeds", "1"]) < 2
    assert "box, stiff, seed 0: " in capsys.readouterr().err
    assert cli.main([*command, "--seeds", "2"]) < 2
    second = capsys.readouterr()
    assert "1 of 2 runs are remembered" in second.err
    assert "seed 0" not in second.err
    rows = json.loads((tmp_path / "scenarios.json").read_text(encoding="utf-8"))["runs"]
    assert [row["seed"] for row in rows] == [0, 1]
    assert second.out == f"{sum(row['passed'] for row in rows)} of 2 runs passed\n"
    short.write_text('bundle = "box"\ncontacts = 1\n', encoding="utf-8")
    command[command.index("box")] = "mug"
    assert cli.main([*command, "--seeds", "1"]) == 1
    assert "failed: object found" in capsys.readouterr().err


def test_random_faults_differ_are_determined_by_the_seed_and_leave_time_to_recover() -> None:
    small = DEMO.on("", SMALL)
    made = [random_faults.drawn(small, seed, 1) for seed in range(300)]
    assert made[:30] == [random_faults.drawn(small, seed, 1) for seed in range(30)]
    assert len({repr(one.fault) for one in made}) > 200, "a fifth have no fault"
    for one in made:
        assert all(fault.end_s < other.at_s for fault, other in pairwise(one.fault))
    faults = [fault for one in made for fault in one.fault]
    assert {fault.kind for fault in faults} == {*random_faults.KINDS}
    assert {fault.module for fault in faults} == {0, 1, 2, 3}
    assert 30 < max(taxel for fault in faults for taxel in fault.taxels) < 40
    assert max(fault.end_s for fault in random_faults.drawn(DEMO, 1, 20).fault) > 900.0


@pytest.mark.check
def test_minutes_of_random_faults_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["matrix", "demo", "--foam", "scene", "--object", "box", "--workers", "1"]
    assert cli.main([*command, "--random", "1", "--seeds", "4", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "scenarios.json").read_text(encoding="utf-8"))["runs"]
    assert len(rows) == 4
    assert any(row["faults"] for row in rows)


@pytest.mark.parametrize(
    ("p", "error_mm", "radius_mm", "found", "sure", "misleading"),
    [
        (1.0, 3.0, 5.0, True, True, False),
        (SURE, 5.0, 5.0, True, True, False),  # exactly at its radius
        (1.0, 6.0, 5.0, True, True, True),  # beyond its radius
        (1.0, 10.0, 20.0, False, True, True),  # 10 mm is not under 10 mm
        (1.0, math.nan, 20.0, False, True, True),  # another object
        (0.98, 99.0, 5.0, False, False, False),  # claims nothing
        (math.nan, 99.0, math.nan, False, False, False),  # a filter that publishes no p
    ],
)
def test_what_is_sure_misleads_unless_it_is_found_and_within_its_radius(
    p: float, error_mm: float, radius_mm: float, found: bool, sure: bool, misleading: bool
) -> None:
    assert integrity.is_found(error_mm) == found
    assert integrity.is_sure(p) == sure
    assert integrity.is_misleading(p, error_mm, radius_mm) == misleading
