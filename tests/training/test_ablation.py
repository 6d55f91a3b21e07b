"""One constant of the filter changed at a time."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.errors import SetupError
from taxeld.estimator import memory, offsets, particles
from taxeld_training.cli import main
from taxeld_training.filters import cells
from taxeld_training.filters.cells import Cell
from taxeld_training.filters.constants import CONSTANTS, Change, changed
from taxeld_training.filters.methods import SHIPPED
from taxeld_training.objects.setting import Setting, ring
from tests.rig.commands import refused

from .rig import evaluate, rows

pytestmark = pytest.mark.check

MUG = Setting("025_mug", ring(16), 16)


def test_a_change_lasts_as_long_as_its_trials_in_all_modules_that_use_the_constant() -> None:
    hidden, move = offsets.HIDDEN, particles.MOVE
    with changed(Change("offsets", "HIDDEN", 9.0)):
        assert {offsets.HIDDEN, memory.HIDDEN} == {9.0}  # imported by name
    assert {offsets.HIDDEN, memory.HIDDEN} == {hidden}
    with changed(Change("particles", "MOVE", (1.0, 2.0, 3.0))):
        assert np.array_equal(particles.MOVE * 2.0, [2.0, 4.0, 6.0])
    assert particles.MOVE is move


def test_a_constant_that_is_gone_is_refused() -> None:
    for change in (Change("mixture", "GONE", 1.0), Change("gone", "MOVES", 1.0)):
        with pytest.raises(SetupError, match="bring CONSTANTS up to date"), changed(change):
            pass


def test_each_constant_of_the_table_matters(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is a default argument, say, would keep its value whatever a change says."""
    monkeypatch.setattr(cells, "TOUCHES", 3)

    def results(seed: int, change: Change | None) -> list[list[Any]]:
        (touches,) = cells.play(Cell(MUG, SHIPPED, change=change), seed, 1, "")
        assert np.isfinite([error_mm for error_mm, *_ in touches]).all(), change
        return [told for *told, _, _ in touches]  # but the times that it took

    usual = {seed: results(seed, None) for seed in (0, 4)}
    assert results(0, None) == usual[0]
    for constant in CONSTANTS:
        tried = product(usual, constant.changes)
        assert any(results(*each) != usual[each[0]] for each in tried), constant.label


def test_ablation_has_a_row_a_value_after_that_of_what_ships(tmp_path: Path) -> None:
    few = ("--groups", "MOVES", "--cells", "as assumed,wrong object=016_pear")
    assert evaluate("ablation", "025_mug", tmp_path, *few) == 0
    found = rows(tmp_path, "ablation")
    wanted = [change for each in CONSTANTS if each.name == "MOVES" for change in each.changes]
    assert [(row["constant"], row["value"]) for row in found] == [
        ("as it ships", None),
        *((f"{change.module}.{change.name}", change.value) for change in wanted),
    ]
    for row in found:
        assert 0.0 <= row["found_and_sure_6"] <= row["found_6"] <= 1.0
        assert row["ms"] > 0.0
        assert row["runs"] == 2
    assert "| as it ships |  | " in (tmp_path / "out" / "ablation.md").read_text("utf-8")


def test_a_constant_that_is_not_in_the_table_is_refused(tmp_path: Path) -> None:
    place = ["--out", str(tmp_path), "--memory", str(tmp_path)]
    fault = "--groups: no 'MAGIC' here; there are SHAPES, "
    assert fault in refused("evaluate", "ablation", "--groups", "MAGIC", *place, main=main)
