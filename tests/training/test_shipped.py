"""The experiment on the configuration that ships."""

import json
from pathlib import Path

import pytest

from taxeld.estimator.estimate import Status
from taxeld_training.cli import main
from taxeld_training.filters import cells
from taxeld_training.filters.figures import p_success, shares
from taxeld_training.filters.methods import TouchResult


def test_a_row_an_object_condition_and_contact_and_a_table_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "evaluate", "shipped", "--seeds", "1", "--objects", "003_cracker_box", "--groups",
        "exact,nudged 1 mm", "--out", str(tmp_path), "--memory", str(tmp_path / "memory"),
    ]  # fmt: skip
    assert main(arguments) == 0
    assert "shipped.md" in capsys.readouterr().out
    rows = json.loads((tmp_path / "shipped.json").read_text(encoding="utf-8"))
    assert [(row["condition"], row["contact"]) for row in rows] == [
        (condition, contact)
        for condition in ("exact", "nudged 1 mm")
        for contact in range(1, cells.TOUCHES + 1)
    ]
    assert all(row["silent_so_far_rate"] >= row["silent_failure_rate"] for row in rows)
    table = (tmp_path / "shipped.md").read_text(encoding="utf-8")
    assert "| 003_cracker_box | nudged 1 mm | " in table


def test_a_silent_failure_counts_at_its_contact_and_ever_after() -> None:
    right, wrong = (TouchResult(mm, mm, Status.CONVERGED, 100, mm) for mm in (1.0, 99.0))
    trials = {0: [right, wrong, right], 1: [right, right, right]}
    rows = [shares(trials, contact) for contact in (1, 2, 3)]
    assert [row["silent_failure_rate"] for row in rows] == [0.0, 0.5, 0.0]
    assert [row["silent_so_far_rate"] for row in rows] == [0.0, 0.5, 0.5]


def test_methods_are_compared_on_the_trials_that_both_have() -> None:
    right, wrong = (TouchResult(mm, mm, Status.CONVERGED, 100, mm) for mm in (1.0, 99.0))
    better = {seed: [right] for seed in range(10)}
    worse = {seed: [right if seed < 4 else wrong] for seed in range(30)}
    assert p_success(better, worse, 1) == pytest.approx(2.0 * 0.5**6)  # six differ, all one way
    assert p_success(better, better, 1) == 1.0


def test_of_two_objects_both_readings_of_success_are_counted() -> None:
    other = TouchResult(1.0, 1.0, Status.CONVERGED, 100, 80.0)
    rates = shares({0: [other], 1: [other._replace(meant_mm=1.0)]}, 1)
    assert (rates["success_rate"], rates["success_meant_rate"]) == (1.0, 0.5)
