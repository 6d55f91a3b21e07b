"""The experiment on the configuration that ships."""

import json
from pathlib import Path

import numpy as np
import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Status
from taxeld.estimator.estimator import Estimator
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import ANALYTIC
from taxeld_training.cli import main
from taxeld_training.filters import cells, gridded, shipped
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.figures import p_success, shares
from taxeld_training.filters.methods import TouchResult
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs.rows import GRID


def test_a_row_an_object_condition_and_contact_and_a_table_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "evaluate", "shipped", "--seeds", "1", "--objects", "003_cracker_box", "--groups",
        "exact,nudged 1 mm", "--out", str(tmp_path), "--memory", str(tmp_path / "memory"),
        "--workers", "1",
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


def test_the_grid_stands_beside_the_default_on_the_trials_that_both_have() -> None:
    right, wrong = (TouchResult(mm, mm, Status.AMBIGUOUS, 100, mm) for mm in (1.0, 99.0))
    default = {0: [right], 1: [wrong], 2: [wrong], 3: [wrong], 9: [wrong]}
    grid = {0: [wrong], 1: [right], 2: [right], 3: [wrong]}
    beside = shipped._beside(grid, default, GRID, 1)
    assert beside == {
        "lost_by_default": 2, "lost_by_grid": 1, "lost_by_both": 1, "p_default": 1.0,
    }  # fmt: skip
    rows = [
        {"object": "box", "condition": "exact", "method": method, "contact": contact}
        | shares(trials, 1)
        | shipped._beside(trials, default, method, 1)
        for method, trials, contacts in (("default", default, range(1, 9)), (GRID, grid, (6,)))
        for contact in contacts
    ]
    lines = shipped._table(rows).splitlines()
    assert lines[-1] == "| box | exact | grid |  |  |  |  |  | 50.0%, 2 / 1 / 1 |  |  |"


def test_an_unknown_condition_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "shipped", "--groups", "exct"]) == 2
    assert "no 'exct' here; there are exact, robot 2 mm" in capsys.readouterr().err


def test_the_grid_learns_from_the_scans_that_the_estimator_learns_from(
    ring_model: ObservationModel,
) -> None:
    """As they are after what may leak, and what foam may keep, was taken off."""
    trial = Trial(ring_model, 3, 3, Conditions(skin="typical"))
    *_, (_, grid) = gridded.after_touches(trial, ring_model)
    config = FilterConfig(injected=0, memory=99)
    estimator = Estimator(ring_model, ANALYTIC["manifold"](ring_model), config)
    for moment in trial:
        estimator.on_scan(moment.activation, moment.sensor)
    memory = estimator.rule.memory  # type: ignore[attr-defined]
    touches = [scan for scan in grid._scans if scan.touched]
    remembered = [k for k in range(len(memory)) if memory.contact[k]]
    assert len(grid._scans) == estimator.counters.updates
    assert [scan.contact for scan in touches] == memory.number[remembered].tolist()
    for scan, k in zip(touches, remembered, strict=True):
        kept = memory.scan(k)
        assert np.allclose(scan.observation.z, kept.z)
        assert np.allclose(scan.observation.residue, kept.residue)
