"""Scenarios on objects and skins: what is counted of them, and what a measurement remembers."""

import json
import shutil
from dataclasses import replace
from importlib import resources
from pathlib import Path

import pytest

from taxeld_hil import cli
from taxeld_hil.experiment import jobs, matrix
from taxeld_hil.experiment.matrix import Outcome, Plan
from taxeld_hil.scenario import scenario

DEMO = scenario.load("demo")
SHORT = """\
bundle = "box"
contacts = 3
[expect]
found = false
[[fault]]
kind = "subscriber_dead"
at_s = 2.0
"""


def outcome(name: str, skin: str, seed: int, **given: object) -> Outcome:
    found = Outcome(
        name, "box", skin, seed, real=False, passed=True, found=True, error_mm=0.5,
        status="converged", contacts=8, silent=0, failed=(),
    )  # fmt: skip
    return replace(found, **given)  # type: ignore[arg-type]


OUTCOMES = [
    outcome("demo", "typical", 0),
    outcome("demo", "typical", 1, passed=False, failed=("unplugged at 4 s: flag",)),
    outcome("reboot", "typical", 0, passed=False, found=False, silent=2, error_mm=None),
    outcome("demo", "poor", 0, bundle="/there/is/a/drill"),
]


def test_a_table_says_how_often_each_object_is_found_what_else_failed_and_what_was_silent() -> None:
    assert list(matrix.lines(OUTCOMES)) == [
        "| scenario | typical, box | poor, drill |",
        "|---|---|---|",
        "| demo | 2 of 2, 1 failed | 1 of 1 |",
        "| reboot | 0 of 1, 1 silent | 0 of 0 |",
        "| **all** | 2 of 3, 1 failed, 1 silent | 1 of 1 |",
    ]
    first, _ = matrix.summary(OUTCOMES)
    assert first == {
        "skin": "typical", "object": "box", "runs": 3, "passed": 1, "found": 2, "silent": 1
    }  # fmt: skip


def test_a_run_of_other_code_another_scenario_or_another_bundle_is_not_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = Path(str(resources.files("taxeld") / "bundles" / "box"))
    copy = shutil.copytree(box, tmp_path / "box")
    mine = DEMO.touching(str(copy))
    codes = [jobs.digest(DEMO), jobs.digest(DEMO.on("poor")), jobs.digest(DEMO, "more"),
             jobs.digest(mine)]  # fmt: skip
    with (copy / "bundle.json").open("a") as file:
        file.write("\n")
    codes.append(jobs.digest(mine))
    assert len(set(codes)) == len(codes)
    assert jobs.digest(DEMO) == codes[0]
    monkeypatch.setattr(jobs, "_code", lambda: "of other code")
    assert jobs.digest(DEMO) not in codes


def test_only_whole_runs_are_remembered(tmp_path: Path) -> None:
    path = tmp_path / "m" / "runs.jsonl"
    with jobs.Memory(path) as memory:
        assert memory.rows({"now"}) == []
        for code, value in (("old", 1), ("now", 2), ("now", 3)):
            memory.add(code, {"value": value})
        assert memory.rows({"now"}) == [{"value": 2}, {"value": 3}]
    path.write_text(path.read_text(encoding="utf-8")[:-3] + "\n", encoding="utf-8")
    with jobs.Memory(path) as memory:
        memory.add("now", {"value": 4})
        assert memory.rows({"now"}) == [{"value": 2}, {"value": 4}]


def test_the_command_goes_on_from_what_it_remembers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a scenario of one's own, with a fault that needs processes: on the fake clock without."""
    short = tmp_path / "short.toml"
    short.write_text(SHORT, encoding="utf-8")
    command = ["matrix", str(short), "--skin", "scene", "--object", "box", "--workers", "1",
               "--memory", str(tmp_path / "runs.jsonl"), "--out", str(tmp_path)]  # fmt: skip
    assert cli.main([*command, "--seeds", "1"]) == 0
    first = capsys.readouterr()
    assert f"1 of 1: {short}, box, scene, seed 0: " in first.err
    assert cli.main([*command, "--seeds", "2"]) == 0
    second = capsys.readouterr()
    assert "1 of 2 runs are remembered" in second.err
    assert "seed 0" not in second.err
    result = json.loads((tmp_path / "scenarios.json").read_text(encoding="utf-8"))
    assert [(run["seed"], run["real"], run["failed"]) for run in result["runs"]] == [
        (0, False, []), (1, False, [])
    ]  # fmt: skip
    assert result["summary"][0]["runs"] == 2
    outcomes = matrix.read(tmp_path / "scenarios.json")
    assert list(matrix.lines(outcomes)) == second.out.splitlines()
    assert "| scenario | scene, box |" in second.out


def test_a_run_that_fails_fails_the_command_and_names_its_checks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hopeless = tmp_path / "hopeless.toml"
    hopeless.write_text('bundle = "box"\ncontacts = 1\nphysics = "scene"\n', encoding="utf-8")
    command = ["matrix", str(hopeless), "--skin", "scene", "--object", "mug", "--seeds", "1",
               "--memory", str(tmp_path / "runs.jsonl"), "--out", str(tmp_path)]  # fmt: skip
    assert cli.main(command) == 1
    assert "failed: object found" in capsys.readouterr().err


def test_what_no_fake_clock_can_do_runs_in_real_time_where_that_is_asked_for() -> None:
    plan = Plan(("demo", "adapter_closed"), ("box",), ("scene",), seeds=1, real=True)
    assert [job.real for job in matrix._jobs(plan)] == [False, True]
    assert not any(job.real for job in matrix._jobs(replace(plan, real=False)))


def test_any_scenario_runs_with_another_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert DEMO.touching("mug").bundle == "mug"
    assert DEMO.touching("") == DEMO
    (tmp_path / "file").touch()
    for command in (["run", "demo", "--clock", "fake"], ["soak"], ["table"]):
        assert cli.main([*command, "--object", "party"]) == 2
        assert capsys.readouterr().err.startswith("scene.bundle: no bundle 'party'")
    for option, value, message in (
        ("--skin", "marble", "no skin 'marble'"),
        ("--object", "party", "scene.bundle: no bundle 'party'"),
        ("--seeds", "0", "--seeds and --workers must be at least 1"),
        ("--memory", str(tmp_path / "file" / "m"), f"--memory: {tmp_path / 'file' / 'm'}: "),
    ):
        assert cli.main(["matrix", "demo", option, value, "--out", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert error.startswith(message)
        assert error.count("\n") == 1
