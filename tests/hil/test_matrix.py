"""Scenarios on objects and skins: what is counted of them, and what a measurement remembers."""

import json
import shutil
from importlib import resources
from pathlib import Path

import pytest

from taxeld.layout import read as layouts
from taxeld_hil import cli
from taxeld_hil.experiment import matrix, measurement
from taxeld_hil.experiment.measurement import RunRow
from tests.hil.rig import DEMO, SKIN
from tests.rig.skins import table_of

SHORT = """\
bundle = "box"
contacts = 3
[expect]
found = false
[[fault]]
kind = "subscriber_dead"
at_s = 2.0
"""


def run(name: str, skin: str, **given: object) -> RunRow:
    """The figures of a run that went well, but for those that are given."""
    fine: RunRow = {"scenario": name, "bundle": "box", "skin": skin, "passed": True, "found": True}
    return {**fine, "layout": "", "status": "converged", "misleading_at_s": [], **given}


def test_a_table_says_how_often_each_object_is_found_what_else_failed_and_what_misled() -> None:
    runs = [
        run("demo", "typical"),
        run("demo", "typical", passed=False),
        run("reboot", "typical", passed=False, found=False, misleading_at_s=[1.0]),
        run("demo", "poor", bundle="/there/is/a/drill"),
        run("demo", "typical", layout="patch", found=False),
    ]
    assert list(matrix.lines(runs)) == [
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
    codes = [measurement.digest(each) for each in (DEMO, DEMO.on("poor"), mine)]
    with (copy / "bundle.json").open("a") as file:
        file.write("\n")
    codes.append(measurement.digest(mine))
    assert len(set(codes)) == len(codes)
    assert measurement.digest(DEMO) == codes[0]
    own, found = tmp_path / "own.csv", set()
    for layout in (SKIN, layouts.load("wrap:modules=12,radius_m=0.04")):
        own.write_text(table_of(layout), encoding="ascii")
        found.add(measurement.digest(DEMO.on("", str(own))))
        measurement.content.cache_clear()  # another process
    assert len(found) == 2, "nor one of a layout file that was changed"
    monkeypatch.setattr(measurement, "code", lambda: "of other code")
    assert measurement.digest(DEMO) not in codes


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
    runs = json.loads((tmp_path / "scenarios.json").read_text(encoding="utf-8"))["runs"]
    assert [run["seed"] for run in runs] == [0, 1]
    assert second.out.splitlines() == list(matrix.lines(runs))
    short.write_text('bundle = "box"\ncontacts = 1\n', encoding="utf-8")
    command[command.index("box")] = "mug"
    assert cli.main([*command, "--seeds", "1"]) == 1
    assert "failed: object found" in capsys.readouterr().err
