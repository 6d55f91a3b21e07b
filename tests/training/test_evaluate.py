"""The samplers' experiments, small: rows, files, and going on after one was cut short."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from taxeld_training.cli import main
from taxeld_training.jobs.options import Options
from taxeld_training.jobs.rows import DISTANCES, EXACT
from taxeld_training.objects.setting import Setting, ring
from taxeld_training.samplers import evaluate, experiment, runs, trainings

FRONTIER = {
    "object", "columns", "proposal", "steps", "width", "flops", "ms", "ms_eager_ddpm100",
    "speedup", "ms_warm", "ms_eager_ddpm100_warm", "speedup_warm", "energy_distance",
    "energy_floor",
}  # fmt: skip


def command(name: str, block: Path, place: Path, *more: str) -> list[str]:
    return [
        "evaluate", name, "--quick", "--objects", str(block), "--out", str(place / "out"),
        "--memory", str(place / "memory"), "--workers", "1", *more,
    ]  # fmt: skip


def test_proposals_writes_a_row_a_sampler_and_remembers_its_jobs(
    block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = command("proposals", block, tmp_path, "--groups", "analytic,density-64")
    assert main(arguments) == 0
    printed = capsys.readouterr().out.split()[-3:]
    assert [Path(line).name for line in printed] == [
        "proposals.json", "proposals.png", "proposals_posterior.png",
    ]  # fmt: skip
    rows = json.loads(Path(printed[0]).read_text(encoding="utf-8"))
    assert {row["proposal"] for row in rows} == {
        "projection", "manifold", "table", "exact", "density",
    }  # fmt: skip
    for row in rows:
        assert {*evaluate.PROPOSALS_KEYS, "p_nearest"} == row.keys()
        assert len(row[DISTANCES]) == 8
        low, high = row["energy_distance_ci"]
        assert low <= row["energy_distance"] <= high
        assert row["left_out"] == 0
        assert row["add_mm"]["best"] <= row["add_mm"]["median"] <= row["add_mm"]["worst"]
        assert row["add_sym_mm"] <= row["add_mm"]["worst"]
    table = Path(printed[0]).with_suffix(".md").read_text(encoding="utf-8").splitlines()
    assert table[0] == "8 columns:"
    assert table[2].startswith("| sampler | objects | energy distance | × floor |")
    assert len(table) == 4 + 5
    assert all(re.search(r"\| \d\.\d{4} \(\d\.\d{4} – \d\.\d{4}\) \|", line) for line in table[4:])
    by_name = {row["proposal"]: row for row in rows}
    assert by_name["exact"]["energy_distance"] == by_name["exact"]["energy_floor"]
    informed = min(by_name, key=lambda name: (name == EXACT, by_name[name]["energy_distance"]))
    assert by_name[informed]["p_nearest"] == 1.0
    assert by_name["projection"]["p_nearest"] < 0.05
    assert by_name["table"]["energy_distance"] < by_name["projection"]["energy_distance"]
    before = sorted(path.stat().st_mtime_ns for path in (tmp_path / "memory").iterdir())
    assert main(arguments) == 0
    assert before == sorted(path.stat().st_mtime_ns for path in (tmp_path / "memory").iterdir())


def test_a_filter_follows_with_the_model_whose_distance_was_measured(
    block: Path, tmp_path: Path
) -> None:
    assert main(command("proposals", block, tmp_path, "--groups", "density-64")) == 0
    kept = list((tmp_path / "memory").glob("density-*.onnx"))
    late = Options(
        tmp_path / "out", tmp_path / "memory", (str(block),), quick=True, until=0.0
    )  # no time to train another
    (cell,) = runs.settings(late, experiment.COLUMNS)
    same = cell.place
    assert type(same) is Setting
    assert trainings.files([(same, "density")], late) == {(same, "density"): str(*kept)}
    other = replace(same, seed=1)
    assert trainings.files([(other, "density")], late) == {}
    assert trainings.files([(other, "table")], late) == {(other, "table"): ""}


def test_frontier_writes_cost_and_distance_of_each_sampler(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the two samplers of 100 steps, whose graphs are slow to export."""
    monkeypatch.setitem(experiment.GROUPS, "frontier", ("analytic", "density-16"))
    monkeypatch.setattr(runs.costs, "EAGER", "density")
    monkeypatch.setattr(runs, "EAGER_SIZE", (1, 16))
    monkeypatch.setattr(runs, "EAGER_GROUP", "density-16")
    assert main(command("frontier", block, tmp_path)) == 0
    rows = json.loads((tmp_path / "out" / "frontier_16.json").read_text(encoding="utf-8"))
    assert len(rows) == 5
    for row in rows:
        assert row.keys() >= FRONTIER
        assert row["speedup"] == pytest.approx(row["ms_eager_ddpm100"] / row["ms"])
        assert row["speedup_warm"] == pytest.approx(row["ms_eager_ddpm100_warm"] / row["ms_warm"])
        assert row["proposal"] != "exact" or row["ms_warm"] == row["ms"]
    table = (tmp_path / "out" / "frontier_16.md").read_text(encoding="utf-8").splitlines()
    assert table[2].endswith("| ms | ms warm | speed-up | speed-up warm | p |")
    assert (tmp_path / "out" / "frontier_16.png").is_file()


def test_without_time_only_remembered_rows_are_written(block: Path, tmp_path: Path) -> None:
    groups = ("--groups", "analytic")
    assert main(command("proposals", block, tmp_path, *groups)) == 0
    more = ("--groups", "analytic,density-16", "--minutes", "0")
    assert main(command("proposals", block, tmp_path, *more)) == 0
    rows = json.loads((tmp_path / "out" / "proposals.json").read_text(encoding="utf-8"))
    assert {row["proposal"] for row in rows} == {
        "projection", "manifold", "table", EXACT,
    }  # fmt: skip


@pytest.mark.parametrize(
    "name", ["proposals", "proposals --cells skin", "frontier", "filter", "stability", "push"]
)
def test_without_time_for_anything_an_experiment_says_so_in_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, *more = name.split()
    assert main(command(first, Path("025_mug"), tmp_path, *more, "--minutes", "0")) == 2
    assert capsys.readouterr().err == (
        "taxeld-train: nothing was measured; give more --minutes, or other --groups\n"
    )


def test_an_unknown_group_or_object_is_refused_in_one_line(
    block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command("proposals", block, tmp_path, "--groups", "magic")) == 2
    assert "--groups: no 'magic'" in capsys.readouterr().err
    assert main(command("proposals", Path("999_none"), tmp_path)) == 2
    assert "999_none" in capsys.readouterr().err


def test_rows_of_another_skin_do_not_stand_in_the_rings_place(block: Path, tmp_path: Path) -> None:
    out = command("proposals", block, tmp_path, "--groups", "analytic", "--skin", ring(4))
    assert main(out) == 0
    (name,) = (path.name for path in (tmp_path / "out").iterdir() if path.suffix == ".json")
    assert name != "proposals.json"
