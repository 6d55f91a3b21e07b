"""The experiment on lengths other than the usual."""

import json
from pathlib import Path

import numpy as np
import pytest

from taxeld_training.cli import main
from taxeld_training.filters.sizes import CASES
from taxeld_training.samplers import trained

BOX = "003_cracker_box"


def test_a_row_an_object_and_lengths_and_a_table_of_them(tmp_path: Path) -> None:
    arguments = [
        "evaluate", "sizes", "--seeds", "1", "--objects", BOX, "--groups", "usual,object 30 mm",
        "--workers", "1", "--out", str(tmp_path), "--memory", str(tmp_path / "memory"),
    ]  # fmt: skip
    assert main(arguments) == 0
    rows = json.loads((tmp_path / "sizes.json").read_text(encoding="utf-8"))
    assert [row["lengths"] for row in rows] == ["usual", "object 30 mm"]
    assert all(row["success_rate"] == 1.0 for row in rows)
    assert rows[0]["diameter_mm"] > 4.0 * rows[1]["diameter_mm"]
    assert f"| {BOX} | object 30 mm | " in (tmp_path / "sizes.md").read_text(encoding="utf-8")


def test_a_world_that_is_smaller_in_all_is_the_same_but_for_its_lengths() -> None:
    usual, small = (trained.model_of(CASES[name].of(BOX)) for name in ("usual", "all by 1/4"))
    assert small.scene.mean_radius == pytest.approx(0.25 * usual.scene.mean_radius, rel=0.02)
    assert small.scene.symmetry == usual.scene.symmetry
    assert np.allclose(small.layout.position_m, 0.25 * usual.layout.position_m)
    assert small.depth_max_m == 0.25 * usual.depth_max_m


def test_what_was_made_larger_is_no_shipped_object() -> None:
    assert trained.shipped(CASES["usual"].of(BOX)) is not None
    assert trained.shipped(CASES["object 300 mm"].of(BOX)) is None
    assert trained.shipped(CASES["depth 2 mm"].of(BOX)) is None


def test_unknown_lengths_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "sizes", "--groups", "radius 30 mm"]) == 2
    assert "no 'radius 30 mm' here; there are usual, " in capsys.readouterr().err
