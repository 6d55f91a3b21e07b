"""The experiment on the configuration that ships."""

import json
from pathlib import Path

import pytest

from taxeld.estimator.estimate import Status
from taxeld_training.cli import main
from taxeld_training.filters import cells, shipped
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
    right, wrong = (TouchResult(mm, mm, Status.CONVERGED, 100) for mm in (1.0, 99.0))
    trials = [[right, wrong, right], [right, right, right]]
    rows = [shipped._row([trial[:k] for trial in trials]) for k in (1, 2, 3)]
    assert [row["silent_failure_rate"] for row in rows] == [0.0, 0.5, 0.0]
    assert [row["silent_so_far_rate"] for row in rows] == [0.0, 0.5, 0.5]
