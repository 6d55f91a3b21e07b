"""Filters in trials, small: rows of the table of conditions, its cells, and what is refused."""

import json
import shutil
from collections.abc import Iterable
from pathlib import Path

import pytest

from taxeld.estimator.estimate import Status
from taxeld_training.charts import trial_charts
from taxeld_training.cli import GONE, main
from taxeld_training.filters import cells, experiment
from taxeld_training.filters.levels import LEVELS, Level
from taxeld_training.filters.methods import TouchResult
from taxeld_training.jobs import tables
from taxeld_training.jobs.options import Options

KEYS = {
    "object", "factor", "level", "proposal", "injection", "particles", "contact", "map_mm",
    "map_mm_ci", "mean_mm", "mean_mm_ci", "success_rate", "success_ci", "success_meant_rate",
    "flagged_rate", "silent_failure_rate", "silent_failure_ci", "silent_so_far_rate",
    "silent_so_far_ci", "found_alone", "shipped_alone", "neither", "p_shipped", "particles_max",
    "particles_mean", "seeds",
}  # fmt: skip


def command(name: str, thing: Path | str, place: Path, *more: str) -> list[str]:
    return [
        "evaluate", name, "--quick", "--objects", str(thing), "--out", str(place / "out"),
        "--memory", str(place / "memory"), "--workers", "1", *more,
    ]  # fmt: skip


def test_filter_has_a_row_a_method_and_contact_and_goes_on_where_it_was_cut(
    block: Path, tmp_path: Path
) -> None:
    few = ("--groups", "table,projection", "--seeds", "3")
    assert main(command("filter", block, tmp_path, *few)) == 0
    file = tmp_path / "out" / "filter.json"
    rows = json.loads(file.read_text(encoding="utf-8"))
    assert [(row["proposal"], row["injection"], row["contact"]) for row in rows] == [
        (proposal, injection, contact)
        for proposal in ("table", "projection")
        for injection in ("mixture", "paper")
        for contact in range(1, cells.TOUCHES + 1)
    ]
    for row in rows:
        assert row.keys() == KEYS
        assert row["seeds"] == 3
        assert row["map_mm"]["q10"] <= row["map_mm"]["median"] <= row["map_mm"]["q90"]
        assert row["map_mm_ci"][0] <= row["map_mm"]["median"] <= row["map_mm_ci"][1]
        assert row["success_ci"][0] <= row["success_rate"] <= row["success_ci"][1]
        assert row["silent_failure_rate"] <= row["silent_so_far_rate"]
        assert row["p_shipped"] is None  # which was not run
    best = [row for row in rows if (row["proposal"], row["injection"]) == ("table", "mixture")]
    assert best[-1]["map_mm"]["median"] < best[0]["map_mm"]["median"]
    assert file.with_suffix(".png").stat().st_size > 10_000
    assert "block.stl | 1 |" in file.with_suffix(".md").read_text("utf-8")

    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "memory").iterdir()}
    more = ("--groups", "table,projection,manifold", "--seeds", "3", "--minutes", "0")
    assert main(command("filter", block, tmp_path, *more)) == 0  # nothing is begun
    assert json.loads(file.read_text(encoding="utf-8")) == rows
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "memory").iterdir()}


def test_what_ships_and_the_grid_meet_the_same_trials_under_chosen_conditions(
    tmp_path: Path,
) -> None:
    few = ("--groups", "shipped,grid", "--seeds", "1", "--cells", "as assumed,skin=typical")
    assert main(command("filter", "003_cracker_box", tmp_path, *few)) == 0
    assert not (tmp_path / "out" / "filter.json").exists()  # chosen cells have a file of their own
    rows = json.loads((tmp_path / "out" / "filter_cells.json").read_text(encoding="utf-8"))
    given = [("as assumed", 0), ("skin", "typical")]
    assert [(row["factor"], row["level"]) for row in rows] == [
        each for each in given for _ in range(cells.TOUCHES + 3)
    ]
    grid = [row for row in rows if row["proposal"] == "grid"]
    assert [row["contact"] for row in grid] == [4, 6, 8] * 2
    assert all(row["flagged_rate"] is None for row in grid)  # it has no status
    assert all(0.0 <= row["p_shipped"] <= 1.0 for row in rows)


def test_lengths_other_than_the_usual_are_held_to_the_objects_own_size(tmp_path: Path) -> None:
    named = "lengths=usual,lengths=object 30 mm"
    few = ("--groups", "table,density", "--seeds", "1", "--cells", named)
    assert main(command("stability", "003_cracker_box", tmp_path, *few)) == 0
    rows = json.loads((tmp_path / "out" / "stability_cells.json").read_text(encoding="utf-8"))
    assert [row["proposal"] for row in rows if row["level"] != "usual"] == ["table"]
    rows = [row for row in rows if row["proposal"] == "table"]  # the others would be trained
    assert [row["level"] for row in rows] == ["usual", "object 30 mm"]
    assert all(row["success_rate"] == 1.0 for row in rows)
    assert rows[0]["diameter_mm"] > 4.0 * rows[1]["diameter_mm"]


def test_stability_has_the_last_contact_of_each_condition_and_a_map(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    factors = ("as assumed", "drift", "wrong object", "symmetric", "lengths")
    levels = [next(level for level in LEVELS if level.factor == factor) for factor in factors]
    monkeypatch.setattr(experiment, "LEVELS", levels)
    few = ("--seeds", "2", "--groups", "table,projection")
    assert main(command("stability", block, tmp_path, *few)) == 0
    rows = json.loads((tmp_path / "out" / "stability.json").read_text(encoding="utf-8"))
    assert [(row["factor"], row["proposal"]) for row in rows] == [
        (factor, proposal)
        for factor in ("as assumed", "drift", "wrong object")
        for proposal in ("table", "projection")
    ]  # symmetric objects stand beside the map's own alone, and lengths are run where named
    assert all(row.keys() == KEYS for row in rows)
    assert all(row["contact"] == cells.TOUCHES for row in rows)
    assert rows[-1]["map_mm"] == {"q10": None, "median": None, "q90": None}  # of a wrong object
    assert rows[-1]["success_rate"] == 0.0


def test_cells_are_run_alone_by_factor_or_level(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the table's order, and where they are symmetric objects as well."""
    asked: list[str] = []

    def remembered(
        wanted: Iterable[tuple[cells.Cell, int]], options: Options
    ) -> dict[cells.Cell, cells.Results]:
        del options
        asked[:] = [cell.name for cell, _ in wanted]
        touch = TouchResult(1.0, 1.0, Status.CONVERGED, 100, 1.0)
        return {cell: {0: [touch] * cells.TOUCHES} for cell, _ in wanted}

    monkeypatch.setattr(cells, "run", remembered)
    asking = ["evaluate", "stability", "--groups", "table", "--out", str(tmp_path), "--cells"]
    data = tmp_path / "stability_cells.json"
    assert main([*asking, "moved=5,noise,wrong object=035_power_drill"]) == 0
    levels = [("noise", 0.04), ("noise", 0.08), ("noise", 0.15), ("moved", 5.0)]
    levels += [("wrong object", "035_power_drill")]
    rows = json.loads(data.read_text(encoding="utf-8"))
    assert [(row["factor"], row["level"]) for row in rows[::2]] == levels  # of box and mug
    assert len(asked) == 2 * len(levels)
    assert main([*asking, "symmetric"]) == 0
    rows = json.loads(data.read_text(encoding="utf-8"))
    assert [row["object"] for row in rows] == [
        "002_master_chef_can", "024_bowl", "061_foam_brick",
    ]  # fmt: skip
    assert main([*asking, "moved", "--quick"]) == 0
    assert len(asked) == 2 * 4  # what is named is run, quick or not


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ("stability --cells noise,sniff", "--cells: no 'sniff' here; there are as assumed, noise"),
        ("filter --cells moved=3", "--cells: no 'moved=3' here; there are moved=2, moved=5, "),
        ("filter --groups magic", "--groups: no 'magic' here; there are density, table, "),
        ("push --cells noise", "--cells: only proposals, filter and stability have cells"),
        ("proposals --cells columns=8", "--cells: columns=8 changes no reading"),
        *((name, f"'{name}' is no experiment of its own any more; ") for name in GONE),
    ],
)
def test_what_there_is_not_is_refused_in_one_line_that_says_what_there_is(
    arguments: str, fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", *arguments.split(" "), "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert fault in error
    assert error.count("\n") == 1


def test_samplers_are_measured_on_the_touches_of_trials_under_chosen_conditions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On skins that sag and couple, too: nearer than the table, which has learned nothing."""
    few = ("--cells", "as assumed,skin=poor,dead share=0.4")
    assert main(command("proposals", "025_mug", tmp_path, *few)) == 0
    rows = json.loads((tmp_path / "out" / "proposals_cells.json").read_text(encoding="utf-8"))
    found = {(row["level"], row["proposal"]): row["energy_distance"] for row in rows}
    for level in (0, "poor", 0.4):
        assert found[level, "density-64"] < found[level, "projection"] / 4.0
        assert found[level, "floor"] < 0.1
    table = (tmp_path / "out" / "proposals_cells.md").read_text(encoding="utf-8")
    assert "| mug | skin: poor | " in table
    shutil.rmtree(tmp_path / "memory")
    assert main(command("proposals", "061_foam_brick", tmp_path, *few)) == 2
    assert "061_foam_brick: no bundle of it is shipped for this skin" in capsys.readouterr().err


def test_every_level_has_a_name_of_its_own_and_differs_from_what_is_assumed() -> None:
    assert len({level.name for level in LEVELS}) == len(LEVELS)
    assert len({repr(level) for level in LEVELS}) == len(LEVELS)
    plain = Level("as assumed", 0)
    assert LEVELS[0] == plain
    for level in LEVELS[1:]:
        assert repr(level) != repr(Level(level.factor, level.level, seeds=level.seeds))


def test_a_map_of_all_levels_is_small(tmp_path: Path) -> None:
    rows = [
        {
            "object": name, "factor": level.factor, "level": level.level, "contact": 8,
            "proposal": method.proposal, "injection": method.injection,
            "success_rate": (i % 11) / 10.0, "success_ci": [0.0, 1.0], "flagged_rate": 0.3,
            "silent_failure_rate": 0.05 * (i % 3 == 0), "silent_so_far_rate": 0.1, "seeds": 100,
            "map_mm": {"median": 1.0},
        }
        for i, level in enumerate(LEVELS)
        for name in level.objects or experiment.STABILITY.objects
        for method in experiment.STABILITY.methods
    ]  # fmt: skip
    trial_charts.failures(rows, tmp_path / "map.png")
    assert 20_000 < (tmp_path / "map.png").stat().st_size < 300_000
    text = tables.trials(rows)
    assert "| mug | wrong object: power drill | density mixture | " in text
    for name in ("all", "cracker box", "mug"):
        assert f"| density mixture | {name} | " in text
