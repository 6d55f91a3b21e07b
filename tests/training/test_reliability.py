"""What estimates promise, held against the truth: figures, cells and files."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

from taxeld.estimator.estimate import Status
from taxeld_training.filters import cells, levels, reliability
from taxeld_training.filters.cells import Cell
from taxeld_training.filters.levels import LEVELS, Level
from taxeld_training.filters.methods import SHIPPED, TouchResult
from taxeld_training.jobs import promises
from taxeld_training.jobs.options import Options
from taxeld_training.jobs.promises import Promises
from taxeld_training.objects.setting import Setting, ring

from .rig import evaluate, rows, written_at

pytestmark = pytest.mark.check

ROOT = Path(__file__).parents[2]
SHARED = Path(os.environ.get("TAXELD_SHARED", ROOT / ".." / "shared"))
PATCH = SHARED / "data" / "layouts" / "ur10e_link1_patch1.json"
MUG = Setting("025_mug", ring(16), 16)


def touch(mm: float, p: float, radius_mm: float = 5.0) -> TouchResult:
    return TouchResult(mm, Status.AMBIGUOUS, 100, p, 1e-3 * radius_mm)


def given(*touches: TouchResult) -> Promises:
    return reliability.promised([{0: list(touches)}])


def test_the_calibration_error_is_the_gap_between_p_and_the_share_that_is_right() -> None:
    p = np.array([0.95] * 10 + [0.25] * 4 + [0.05] * 2)
    right = np.array([True] * 8 + [False] * 2 + [True] + [False] * 3 + [True] * 2)
    table = promises.reliability(p, right)
    assert [(row["from"], row["n"], row["mean_p"], row["right"]) for row in table] == [
        (0.0, 2, 0.05, 1.0),
        (0.2, 4, 0.25, 0.25),
        (0.9, 10, 0.95, 0.8),
    ]
    expected = (2 * 0.95 + 4 * 0.0 + 10 * 0.15) / 16
    assert promises.calibration_error(table) == pytest.approx(expected, abs=1e-4)
    assert promises.calibration_error([]) is None


def test_bins_are_a_tenth_wide_and_certainty_is_in_the_last() -> None:
    p = np.array([0.0, 0.1, 0.19, 0.9, 1.0])
    table = promises.reliability(p, np.zeros(5, dtype=np.bool_))
    assert [(row["from"], row["n"]) for row in table] == [(0.0, 1), (0.1, 2), (0.9, 2)]


def test_shares_of_estimates_have_no_interval_as_if_each_were_a_trial() -> None:
    results = {0: [touch(1.0, 1.0)] * 8}
    every = reliability.promised([results])
    (row,) = promises.reliability(every.p, every.found)
    assert not {"right_ci", "misleading_ci"} & {*row, *promises.kept(every)}


def test_what_misleads_is_a_share_of_what_is_sure() -> None:
    found = promises.kept(
        given(
            touch(6.0, 0.99),  # found, but beyond its radius
            touch(5.0, 1.0),  # found, and exactly at its radius
            touch(10.0, 0.995, 20.0),  # not found, though inside its radius
            touch(30.0, 0.98),  # not sure
            touch(math.nan, 0.999),  # another object is never found
        )
    )
    assert (found["estimates"], found["sure"], found["misleading"]) == (5, 4, 3)
    assert (found["misleading_rate"], found["radius_mm"]) == (0.75, 5.0)


def test_shares_after_a_contact_are_of_the_runs_with_the_right_object() -> None:
    good, bad, other = touch(1.0, 1.0), touch(99.0, 1.0), touch(math.nan, 1.0)
    runs = {0: [good] * 8, 1: [good] * 5 + [bad] * 3, 2: [other] * 8}
    found = promises.kept(reliability.promised([runs]))
    assert [found[f"found_and_sure_{k}"] for k in (4, 6, 8)] == [1.0, 0.5, 0.5]
    assert [found[f"misleading_{k}"] for k in (4, 6, 8)] == [0.0, 0.5, 0.5]


def test_promises_are_remembered_with_the_estimates_that_make_them(tmp_path: Path) -> None:
    options = Options(tmp_path, tmp_path / "memory", workers=1)
    first, again = (cells.run([(Cell(MUG, SHIPPED), 1)], options) for _ in range(2))
    assert first == again
    ((run,),) = (results.values() for results in first.values())
    for result in run:
        assert 0.0 <= result.p <= 1.0 + 1e-9
        assert result.radius_m > 0.0
        assert result.cpu_ms > 0.0
        assert sum(result.hypotheses) == pytest.approx(1.0)


def test_the_halves_are_fixed_and_each_object_is_taken_for_others_on_each_skin() -> None:
    every, options = reliability.all_levels(), Options(Path(), Path(), layouts=("", ring(8)))
    found = levels.asked_for(options, every, every)
    assert len({level.name for level in found}) == len(found)
    assert found[: len(LEVELS)] == list(LEVELS)
    pairs = {(level.touched, level.conditions.skin) for level in found if level.touched}
    objects = {*reliability.MET, *levels.UNMET}
    assert len(objects) == len(reliability.MET) + 10
    assert pairs == {(name, skin) for name in objects for skin in levels.FOAMS}
    cell = Cell(MUG, SHIPPED)
    new = {level.factor for level in found if not reliability.is_tuned(level, cell)}
    assert new == {"lengths", "layout", *(f for f in (x.factor for x in found) if "wrong" in f)}
    assert reliability.is_tuned(Level("wrong object", "x", touched="024_bowl"), cell)
    assert not reliability.is_tuned(Level("wrong object", "x", touched="013_apple"), cell)


def test_no_object_is_taken_for_itself() -> None:
    level = Level("wrong object", "016_pear", touched="016_pear")
    named = Options(Path(), Path(), objects=("016_pear", "025_mug"))
    ((_, cell),) = reliability.wanted([level], named, 3)
    assert cell.setting.object == "025_mug"


def test_reliability_has_groups_and_cells_and_goes_on_where_it_was_cut(
    block: Path, tmp_path: Path
) -> None:
    few = ("--cells", "as assumed,wrong object=016_pear,moved=5,lengths=usual")
    assert evaluate("reliability", block, tmp_path, *few) == 0
    found = rows(tmp_path, "reliability_cells")
    over = {row["over"]: row for row in found if "over" in row}
    single = {row["factor"]: row for row in found if "over" not in row}
    assert list(single) == ["as assumed", "moved", "lengths", "wrong object"]
    assert not any(row["tuned"] for row in single.values())  # the block was not tuned on
    assert over.keys() == {"all", "not tuned", "wrong object"}
    assert over["all"]["estimates"] == sum(row["estimates"] for row in single.values())
    assert over["all"]["sure"] == sum(row["sure"] for row in single.values())
    assert single["wrong object"]["found_and_sure_6"] is None
    picture = (tmp_path / "out" / "reliability_cells.png").stat().st_size
    assert 10_000 < picture < 300_000

    before = written_at(tmp_path / "memory")
    assert evaluate("reliability", block, tmp_path, *few, "--minutes", "0") == 0
    assert rows(tmp_path, "reliability_cells") == found
    assert written_at(tmp_path / "memory") == before


@pytest.mark.skipif(not PATCH.is_file(), reason="the real layouts are not beside this checkout")
def test_a_real_patch_is_a_cell_on_each_foam_and_one_that_is_absent_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ("--layout", str(PATCH), "--layout", "absent.json", "--seeds", "1")
    assert evaluate("reliability", "025_mug", tmp_path, *few, "--cells", "layout") == 0
    assert "no file absent.json: its rows are left out" in capsys.readouterr().err
    single = [row for row in rows(tmp_path, "reliability_cells") if "over" not in row]
    assert [row["level"] for row in single] == [
        f"{PATCH.stem}, {foam}" for foam in ("exact", "typical", "poor")
    ]
    assert all(row["estimates"] == 8 and not row["tuned"] for row in single)
    assert {row["proposal"] for row in single} == {"table"}


def test_stability_has_rows_of_each_layout_with_samples_from_the_table(
    block: Path, tmp_path: Path
) -> None:
    other = ring(8, radius_m=0.05)
    few = ("--layout", "own", "--layout", other, "--cells", "as assumed,layout", "--seeds", "1")
    assert evaluate("stability", block, tmp_path, *few, "--groups", "table,shipped") == 0
    found = rows(tmp_path, "stability_cells")
    assert [row["factor"] for row in found if row["proposal"] == "table"] == [
        "as assumed",
        *["layout"] * 3,
    ]
    assert {row["proposal"] for row in found if row["factor"] == "layout"} == {"table"}


@pytest.mark.parametrize("name", ["recognise", "push"])
def test_what_has_no_rows_for_layouts_refuses_them_in_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(name, "025_mug", tmp_path, "--layout", ring(4), "--layout", ring(8)) == 2
    assert capsys.readouterr().err.startswith("taxeld-train: --layout: ")
