"""Experiments, small: rows and files, and going on after one was cut short."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from taxeld_hil import jobs
from taxeld_training.cli import main
from taxeld_training.filters import advised, cells, linked, stability, whole
from taxeld_training.filters.levels import LEVELS, Level
from taxeld_training.filters.methods import GRID, Method, TouchResult
from taxeld_training.jobs import options, statistics
from taxeld_training.jobs.options import Options
from tests.rig.commands import refused

from .rig import evaluate, rows, written_at

pytestmark = pytest.mark.check

TRIAL_KEYS = {
    "object",
    "factor",
    "level",
    "proposal",
    "injection",
    "particles",
    "contact",
    "median_mm",
    "found_rate",
    "found_ci",
    "sure_rate",
    "misleading_rate",
    "misleading_ci",
    "misleading_so_far_rate",
    "misleading_so_far_ci",
    "p_shipped",
    "particles_max",
    "seeds",
}


@pytest.mark.parametrize(
    "name",
    [
        "whole",
        "works",
        "stability",
        "reliability",
        "recognise",
        "advice",
        "push",
    ],
)
def test_without_time_for_anything_an_experiment_says_so_in_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, *more = name.split()
    assert evaluate(first, "025_mug", tmp_path, *more, "--minutes", "0") == 2
    assert capsys.readouterr().err == (
        "taxeld-train: nothing was measured; give more --minutes, or other --groups\n"
    )


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ("filter --seeds 5", "evaluate filter: is gone; 'evaluate whole' compares filters"),
        ("proposals --quick", "evaluate proposals: is gone; 'taxeld-train build' measures"),
        (
            "works --columns 8",
            "evaluate --columns: is gone; a ring of 8 columns is --cells",
        ),
        ("works --objects 999_none", "999_none"),
        ("stability --cells noise,sniff", "--cells: no 'sniff' here; there are as assumed, noise"),
        ("stability --cells moved=3", "--cells: no 'moved=3' here; there are moved=2, moved=5, "),
        ("stability --groups magic", "--groups: no 'magic' here; there are density, table, "),
        ("push --cells noise", "--cells: push has no cells to choose from"),
        ("recognise --cells noise", "--cells: recognise has no cells to choose from"),
        ("recognise --objects 025_mug,999_none", "999_none: no such YCB object"),
        ("advice --cells noise", "--cells: no 'noise'; there are exact, typical, robot 1 mm"),
        ("advice --groups magic", "--groups: no 'magic'; there are any, random, "),
        ("links --cells noise", "--cells: links has no cells to choose from"),
        ("links --layout cylinder:rows=2,columns=8,radius_m=0.03,pitch_m=0.02", "takes two, not 1"),
        ("push --objects 016_pear", "016_pear has no shipped bundle"),
    ],
)
def test_what_there_is_not_is_refused_in_one_line_that_says_what_there_is(
    arguments: str, fault: str, tmp_path: Path
) -> None:
    place = ["--out", str(tmp_path), "--memory", str(tmp_path), "--workers", "1"]
    assert fault in refused("evaluate", *arguments.split(" "), *place, main=main)


def test_whole_filters_are_compared_by_time_and_by_what_they_find(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = [each for each in whole.FILTERS if each.proposal == "table"]
    monkeypatch.setattr(whole, "FILTERS", [kept[0], kept[8], kept[-1]])
    monkeypatch.setattr(whole.enough, "LEAST", 4)
    asked = "--cells", "as assumed", "--seeds", "2"
    assert evaluate("whole", "025_mug,003_cracker_box", tmp_path, *asked) == 0
    found = rows(tmp_path, "whole")
    assert len(found) == 9
    for name in ("all", "025_mug", "003_cracker_box"):
        mine = [row for row in found if row["object"] == name]
        assert [row["trials"] for row in mine] == [4 if name == "all" else 2] * 3
        assert [row["ms"] for row in mine] == sorted(row["ms"] for row in mine)
        shares = [row["found_and_sure"][5] / row["trials"] for row in mine]
        for k, row in enumerate(mine):
            assert row["on_front"] == (shares[k] > max([-1.0, *shares[:k]]))
            assert row["idle_ms"] > 0.0
        assert sum(row["ships"] for row in mine) == 1
        assert sum(row["enough"] for row in mine) == (name == "all")  # it has trials enough
        (alone,) = (row for row in mine if row["samples"] == 0)
        assert alone["found"][-1] <= max(row["found"][-1] for row in mine)
    assert (tmp_path / "out" / "whole.png").is_file()


def test_links_are_compared_on_the_same_touches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linked, "SKINS", ("exact",))
    monkeypatch.setattr(linked, "model_of", cache(linked.model_of))
    assert evaluate("links", "003_cracker_box", tmp_path, "--seeds", "1") == 0
    found = {(row["skin"], row["links"]): row for row in rows(tmp_path, "links")}
    assert {links for _, links in found} == {"first", "second", "both"}
    for row in found.values():
        assert row["trials"] == 1
        assert row["found"][-1] == 1
        assert row["misleading"] == 0
    first, both = found["exact", "first"], found["exact", "both"]
    assert first["found"][0] == both["found"][0]  # the first touch is the same


def test_guides_are_compared_from_the_same_first_touch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(advised, "CELLS", {"exact": advised.CELLS["exact"]})
    few = ("--seeds", "1", "--groups", "any,random,advice")
    assert evaluate("advice", "025_mug", tmp_path, *few) == 0
    found = {row["guide"]: row for row in rows(tmp_path, "advice")}
    assert set(found) == {"any", "random", "advice"}
    assert len({row["found"][0] for row in found.values()}) == 1
    assert found["advice"]["advice_ms"] > 0.0
    assert "advice_ms" not in found["random"]


def test_stability_goes_on_where_it_was_cut_and_compares_with_what_ships(
    block: Path, tmp_path: Path
) -> None:
    few = ("--cells", "as assumed,noise=0.04", "--seeds", "2", "--groups")
    assert evaluate("stability", block, tmp_path, *few, "table,projection") == 0
    assert not (tmp_path / "out" / "stability.json").exists(), "chosen cells have their own file"
    found = rows(tmp_path, "stability_cells")
    for row in found:
        assert row.keys() == TRIAL_KEYS
        assert row["seeds"] == 2
        assert row["median_mm"] > 0.0
        assert row["found_ci"][0] <= row["found_rate"] <= row["found_ci"][1]
        assert row["misleading_rate"] <= row["misleading_so_far_rate"]
        assert row["p_shipped"] is None, "what ships was not run"
    assert (tmp_path / "out" / "stability_cells.png").stat().st_size > 5_000
    before = written_at(tmp_path / "memory")
    more = ("table,projection,density", "--minutes", "0")
    assert evaluate("stability", block, tmp_path, *few, *more) == 0  # nothing is begun
    assert rows(tmp_path, "stability_cells") == found
    assert written_at(tmp_path / "memory") == before


def test_what_ships_and_the_grid_meet_the_same_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (cells, stability):
        monkeypatch.setattr(module, "TOUCHES", 2)
    monkeypatch.setattr(stability, "LIMIT", Method(GRID, touches=(2,)))
    few = ("--groups", "shipped,grid", "--seeds", "1", "--cells", "as assumed")
    assert evaluate("stability", "003_cracker_box", tmp_path, *few) == 0
    ours, grid = rows(tmp_path, "stability_cells")
    assert (ours["proposal"], grid["proposal"]) == ("density", "grid")
    assert grid["sure_rate"] is None, "it publishes no p"
    assert all(0.0 <= row["p_shipped"] <= 1.0 for row in (ours, grid))


def test_lengths_other_than_the_usual_are_held_to_the_objects_own_size(tmp_path: Path) -> None:
    named = "lengths=usual,lengths=object 30 mm"
    few = ("--groups", "table,density", "--seeds", "1", "--cells", named)
    assert evaluate("stability", "003_cracker_box", tmp_path, *few) == 0
    found = rows(tmp_path, "stability_cells")
    # a density would have to be trained for other lengths, and is left out there
    assert [row["proposal"] for row in found if row["level"] != "usual"] == ["table"]
    found = [row for row in found if row["proposal"] == "table"]
    assert [row["level"] for row in found] == ["usual", "object 30 mm"]
    assert all(row["found_rate"] == 1.0 for row in found)
    assert found[0]["diameter_mm"] > 4.0 * found[1]["diameter_mm"]


def test_stability_has_the_last_contact_of_each_condition_and_a_map(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    factors = ("as assumed", "drift", "wrong object", "symmetric", "lengths")
    levels = [next(level for level in LEVELS if level.factor == factor) for factor in factors]
    monkeypatch.setattr("taxeld_training.filters.stability.LEVELS", levels)
    few = ("--seeds", "1", "--groups", "table,projection")
    assert evaluate("stability", block, tmp_path, *few) == 0
    found = rows(tmp_path, "stability")
    assert [(row["factor"], row["proposal"]) for row in found] == [
        (factor, proposal)
        for factor in ("as assumed", "drift", "wrong object")
        for proposal in ("table", "projection")
    ]  # symmetric objects stand beside the map's own alone, and lengths are run where named
    assert all(row.keys() == TRIAL_KEYS for row in found)
    assert all(row["contact"] == cells.TOUCHES for row in found)
    assert found[-1]["median_mm"] is None  # of a wrong object
    assert found[-1]["found_rate"] == 0.0


def test_cells_are_run_alone_by_factor_or_level(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the table's order, and where they are symmetric objects as well."""

    def remembered(
        wanted: list[tuple[cells.Cell, int]], options: Options
    ) -> dict[cells.Cell, cells.Results]:
        del options
        touch = TouchResult(1.0, cells.Status.CONVERGED, 100)
        return {cell: {0: [touch] * cells.TOUCHES} for cell, _ in wanted}

    monkeypatch.setattr(cells, "run", remembered)

    def asked(*more: str) -> list[tuple[str, str, float | str]]:
        out = ["--out", str(tmp_path / "out"), "--groups", "table", "--cells", *more]
        assert main(["evaluate", "stability", *out]) == 0
        found = rows(tmp_path, "stability_cells")
        return [(row["object"], row["factor"], row["level"]) for row in found]

    levels = [("noise", 0.04), ("noise", 0.08), ("noise", 0.15), ("moved", 5.0)]
    levels += [("wrong object", "022_windex_bottle")]
    assert asked("moved=5,noise,wrong object=022_windex_bottle") == [
        (name, *level) for level in levels for name in ("003_cracker_box", "025_mug")
    ]
    symmetric = ["002_master_chef_can", "024_bowl", "061_foam_brick"]
    assert [name for name, *_ in asked("symmetric")] == symmetric
    assert len(asked("moved", "--quick")) == 2 * 4  # what is named is run, quick or not


def test_every_level_has_a_name_of_its_own_and_differs_from_what_is_assumed() -> None:
    assert len({level.name for level in LEVELS}) == len(LEVELS)
    assert len({repr(level) for level in LEVELS}) == len(LEVELS)
    assert LEVELS[0] == Level("as assumed", 0)
    for level in LEVELS[1:]:
        assert repr(level) != repr(Level(level.factor, level.level, seeds=level.seeds))


def test_push_has_a_row_an_object_and_motion_and_following_is_nearer(tmp_path: Path) -> None:
    assert evaluate("push", "003_cracker_box", tmp_path, "--seeds", "1") == 0
    found = rows(tmp_path, "push")
    assert [(row["object"], row["motion"]) for row in found] == [
        ("003_cracker_box", motion) for motion in ("push", "none", "told")
    ]
    assert all(r["path_mm_ci"][0] <= r["path_mm"]["median"] <= r["path_mm_ci"][1] for r in found)
    followed, ignored, told = (row["path_mm"]["median"] for row in found)
    assert max(followed, told) < ignored


def test_other_code_and_other_bundles_have_a_memory_of_their_own(tmp_path: Path) -> None:
    """What an older bundle, or other code, came to is not taken for what today's does."""
    names = {jobs.code(decides) for decides in (options.DECIDES, *zip(options.DECIDES))}
    assert len(names) == 1 + len(options.DECIDES)  # each of them has files
    assert Options(tmp_path, tmp_path).measured == tmp_path / jobs.code(options.DECIDES)


def test_an_interval_of_a_mean_is_that_of_its_standard_error() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(5.0, 2.0, 400)
    low, high = statistics.of_mean([values], rng)
    assert (low + high) / 2 == pytest.approx(values.mean(), abs=0.05)
    assert high - low == pytest.approx(2 * 1.96 * 2.0 / 20.0, rel=0.2)
    # groups weigh alike, and their differences are no noise
    assert statistics.of_mean([np.zeros(1000), np.full(10, 1.0)], rng) == (0.5, 0.5)


def test_an_interval_of_a_median_holds_it_and_rows_are_drawn_as_a_whole() -> None:
    rng = np.random.default_rng(0)
    readings = rng.normal(0.0, 1.0, (60, 1)) + np.zeros(100)  # a reading's samples are alike
    low, high = statistics.of_median(readings, rng)
    assert low < np.median(readings) < high
    assert high - low > 0.2  # as of 60 values, not of 6000


def test_a_share_of_none_is_not_certain() -> None:
    assert statistics.of_count(0, 100) == pytest.approx((0.0, 0.037), abs=1e-3)
    half = statistics.of_count(50, 100)
    assert half == pytest.approx((0.404, 0.596), abs=1e-3)


def test_pairs_tell_what_their_spread_hides() -> None:
    first = [True] * 90 + [False] * 10
    second = [True] * 80 + [False] * 20
    assert statistics.p_share(first, second) == pytest.approx(2.0 * 0.5**10)
    assert statistics.p_share(first, first) == 1.0
