"""Many runs, as jobs: scenarios on objects and skins, and laps of random faults; and the words that
their estimates are judged by."""

import json
import math
import shutil
from dataclasses import replace
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from taxeld.estimator.estimate import SURE
from taxeld.layout import read as layouts
from taxeld_hil import cli, integrity
from taxeld_hil.experiment import runs, soak
from taxeld_hil.experiment.runs import RunRow
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.trials import case
from tests.hil.rig import DEMO, SKIN
from tests.rig.skins import table_of

SMALL = "cylinder:rows=2,columns=20,radius_m=0.04,pitch_m=0.015"  # four modules of ten taxels
SHORT = """\
bundle = "box"
contacts = 3
expect = {found = false}
fault = [{kind = "flooded", at_s = 2.0}]
"""


def run(name: str, skin: str, **given: object) -> RunRow:
    """The figures of a run that went well, but for those that are given."""
    fine: RunRow = {"scenario": name, "bundle": "box", "skin": skin, "passed": True, "found": True}
    return {**fine, "layout": "", "status": "converged", "misleading_at_s": [], **given}


def test_a_table_says_how_often_each_object_is_found_what_else_failed_and_what_misled() -> None:
    rows = [
        run("demo", "typical"),
        run("demo", "typical", passed=False),
        run("reboot", "typical", passed=False, found=False, misleading_at_s=[1.0]),
        run("demo", "poor", bundle="/there/is/a/drill"),
        run("demo", "typical", layout="patch", found=False),
    ]
    assert list(runs.lines(rows)) == [
        "| scenario | typical, box | poor, drill |",
        "|---|---|---|",
        "| demo | 2 of 2, 1 failed | 1 of 1 |",
        "| reboot | 0 of 1, 1 misleading | 0 of 0 |",
        "| **all** | 2 of 3, 1 failed, 1 misleading | 1 of 1 |",
        "| demo, patch | 0 of 1 | 0 of 0 |",
        "| reboot, patch | 0 of 0 | 0 of 0 |",
        "| **all**, patch | 0 of 1 | 0 of 0 |",
    ]


def test_a_run_of_other_code_another_scenario_or_another_bundle_is_not_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = Path(str(resources.files("taxeld") / "bundles" / "box"))
    copy = shutil.copytree(box, tmp_path / "box")
    mine = DEMO.touching(str(copy))

    def code(subject: Scenario) -> str:
        return runs.of("demo", subject, 0).code

    codes = [code(each) for each in (DEMO, DEMO.on("poor"), mine)]
    with (copy / "bundle.json").open("a") as file:
        file.write("\n")
    codes.append(code(mine))
    assert len(set(codes)) == len(codes)
    assert code(DEMO) == codes[0]
    own, found = tmp_path / "own.csv", set()
    for layout in (SKIN, layouts.load("wrap:modules=12,radius_m=0.04")):
        own.write_text(table_of(layout), encoding="ascii")
        found.add(code(DEMO.on("", str(own))))
    assert len(found) == 2, "nor one of a layout file that was changed"
    monkeypatch.setattr(case, "code", lambda: "of other code")
    assert code(DEMO) not in codes


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
    assert second.out.splitlines() == list(runs.lines(rows))
    short.write_text('bundle = "box"\ncontacts = 1\n', encoding="utf-8")
    command[command.index("box")] = "mug"
    assert cli.main([*command, "--seeds", "1"]) == 1
    assert "failed: object found" in capsys.readouterr().err


@pytest.mark.check
def test_a_soak_has_a_row_a_lap_and_goes_on_from_the_laps_that_were_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = tmp_path / "scene.toml"
    scene.write_text('bundle = "box"\nphysics = "scene"\n', encoding="utf-8")
    for minutes in (1, 2):
        command = ["soak", str(scene), "--hours", str(minutes / 60), "--seed", "5"]
        assert cli.main([*command, "--out", str(tmp_path / "soak.json")]) in (0, 1)
        rows = json.loads((tmp_path / "soak.json").read_text(encoding="utf-8"))["runs"]
        assert len(rows) == minutes
        said = capsys.readouterr()
        assert f" h; {minutes} laps, " in said.out
        assert "; 0 accounts do not balance; " in said.out
    assert "1 of 2 runs are remembered" in said.err
    for number, row in enumerate(rows):
        lap = soak.lap(replace(DEMO, physics="scene"), 5, number)
        assert [each["at_s"] for each in row["faults"]] == [fault.at_s for fault in lap.fault]


def soaked(*given: dict[str, Any]) -> list[RunRow]:
    """Laps that went well, but for what is given of each."""
    fine = {"faults": [], "touches": 8, "contacts": 8, "seconds": 60.0, "failed": []}
    return [run("lap", "typical", **fine, growth_mb=0.0) | each for each in given]


def fault(kind: str, at_s: float = 1.0, **more: object) -> dict[str, Any]:
    row = {"kind": kind, "at_s": at_s, "injected": True, "recovered_s": 0.1, "doubted": False}
    return {**row, "overlapped": False, **more}


def test_a_lie_that_was_told_earlier_in_the_lap_explains_what_misleads_and_no_other_does() -> None:
    lied = [fault("pose_jumping", 4.0), fault("dropped", 9.0)]
    other = [fault("reboot", 2.0), fault("dropped", 9.0), fault("pose_late", 20.0)]
    for faults, at_s, blamed in (
        (lied, 12.0, "pose_jumping"),
        (lied, 3.0, "none"),
        (other, 12.0, "dropped"),
    ):
        rows = soaked({"faults": faults, "misleading_at_s": [at_s]})
        assert f"misleading after {blamed} 1" in soak.described(rows)
        assert soak.passed(rows) == (blamed in soak.DECEPTIVE)


LOST = fault("reboot", recovered_s=None)


@pytest.mark.parametrize(
    ("given", "passes"),
    [
        ({}, True),
        ({"faults": [LOST | {"doubted": True}, LOST | {"overlapped": True}]}, True),
        ({"faults": [LOST | {"injected": False}]}, True),
        ({"faults": [LOST]}, False),
        ({"failed": ["accounts: scans"]}, False),
        ({"failed": ["reboot at 2 s: flag"]}, True),
        ({"growth_mb": 8.0}, False),
    ],
)
def test_a_soak_passes_if_all_is_accounted_for_all_recovered_and_memory_is_flat(
    given: dict[str, Any], passes: bool
) -> None:
    assert soak.passed(soaked({}, given)) == passes


def test_laps_whose_contacts_were_all_felt_are_counted_apart() -> None:
    felt = (("converged", 8), ("ambiguous", 8), ("converged", 5), ("ambiguous", 3))
    rows = [{"status": status, "contacts": contacts} for status, contacts in felt]
    assert "4 laps, 2 found and sure, 1 of 2 full ones" in soak.described(soaked(*rows))


def test_laps_differ_and_are_determined_by_seed_and_number() -> None:
    small = DEMO.on("", SMALL)
    made = [soak.lap(small, 1, number) for number in range(300)]
    assert made[:30] == [soak.lap(small, 1, number) for number in range(30)]
    assert len({repr(lap.fault) for lap in made}) > 200, "a fifth have no fault"
    for lap in made:
        assert all(one.end_s < other.at_s for one, other in pairwise(lap.fault))
    faults = [fault for lap in made for fault in lap.fault]
    assert {fault.kind for fault in faults} == {*soak.KINDS}
    assert {fault.module for fault in faults} == {0, 1, 2, 3}
    assert 30 < max(taxel for fault in faults for taxel in fault.taxels) < 40
    assert max(fault.end_s for fault in soak.lap(DEMO, 1, 0, minutes=20).fault) > 900.0


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
