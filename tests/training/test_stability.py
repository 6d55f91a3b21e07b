"""The stability experiment, small: rows, what counts as a failure, and the map."""

import json
import math
from collections.abc import Iterable
from pathlib import Path

import pytest
import trimesh

from taxeld.estimator.estimate import Status
from taxeld_training.charts import stability_map
from taxeld_training.cli import main
from taxeld_training.filters import cells, stability
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.figures import shares
from taxeld_training.filters.methods import SHIPPED, Method, TouchResult
from taxeld_training.filters.stability import LEVELS, Level
from taxeld_training.jobs.options import Options
from taxeld_training.objects.setting import Setting, ring

KEYS = {
    "object", "factor", "level", "proposal", "injection", "success_rate", "success_ci",
    "success_meant_rate", "flagged_rate", "silent_failure_rate", "silent_failure_ci",
    "silent_so_far_rate", "silent_so_far_ci", "p_first", "seeds",
}  # fmt: skip


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "block.stl"
    trimesh.creation.box((0.06, 0.1, 0.1)).export(path)
    return path


def test_rows_and_map_of_an_object(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    levels = [
        next(level for level in LEVELS if level.factor == factor)
        for factor in ("as assumed", "drift", "wrong object", "symmetric")
    ]
    monkeypatch.setattr(stability, "LEVELS", levels)
    arguments = [
        "evaluate", "stability", "--quick", "--objects", str(block), "--seeds", "2", "--groups",
        "table,projection", "--out", str(tmp_path / "out"), "--memory", str(tmp_path / "memory"),
        "--workers", "1",
    ]  # fmt: skip
    assert main(arguments) == 0
    file = tmp_path / "out" / "stability.json"
    rows = json.loads(file.read_text(encoding="utf-8"))
    assert [(row["factor"], row["proposal"]) for row in rows] == [
        (factor, proposal)
        for factor in ("as assumed", "drift", "wrong object")
        for proposal in ("table", "projection")
    ]  # symmetric objects stand beside the map's own alone
    for row in rows:
        assert row.keys() == KEYS
        assert row["seeds"] == 2
    assert 10_000 < file.with_suffix(".png").stat().st_size < 300_000
    assert "| table mixture | all | 3 |" in file.with_suffix(".md").read_text(encoding="utf-8")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "memory").iterdir()}
    assert main([*arguments, "--minutes", "0"]) == 0
    assert json.loads(file.read_text(encoding="utf-8")) == rows
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "memory").iterdir()}


def test_cells_are_run_alone_by_factor_or_level(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the map's order, and where they are symmetric objects as well."""
    asked: list[str] = []

    def remembered(
        wanted: Iterable[tuple[cells.Cell, int]], options: Options
    ) -> dict[cells.Cell, cells.Results]:
        del options
        asked[:] = [cell.name for cell, _ in wanted]
        touch = TouchResult(1.0, 1.0, Status.CONVERGED, 100, 1.0)
        return {cell: {0: [touch] * cells.TOUCHES} for cell, _ in wanted}

    monkeypatch.setattr(cells, "run", remembered)
    command = ["evaluate", "stability", "--groups", "table", "--out", str(tmp_path), "--cells"]
    data = tmp_path / "stability.json"
    assert main([*command, "moved=5,noise,wrong object=035_power_drill"]) == 0
    levels = [("noise", 0.04), ("noise", 0.08), ("noise", 0.15), ("moved", 5.0)]
    levels += [("wrong object", "035_power_drill")]
    rows = json.loads(data.read_text(encoding="utf-8"))
    assert [(row["factor"], row["level"]) for row in rows[::2]] == levels  # of box and mug
    assert len(asked) == 2 * len(levels)
    assert main([*command, "symmetric"]) == 0
    rows = json.loads(data.read_text(encoding="utf-8"))
    assert [row["object"] for row in rows] == list(stability.SYMMETRIC)
    assert main([*command, "moved", "--quick"]) == 0
    assert len(asked) == 2 * 4  # what is named is run, quick or not


@pytest.mark.parametrize(
    ("cells_named", "there"),
    [
        ("noise,sniff", "no 'sniff' here; there are as assumed, noise, gain spread, "),
        ("moved=3", "no 'moved=3' here; there are moved=2, moved=5, moved=25, moved=kidnapped"),
    ],
)
def test_a_cell_that_is_not_on_the_map_is_refused_in_one_line_with_those_that_are(
    cells_named: str, there: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", "stability", "--out", str(tmp_path), "--cells", cells_named]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert f"--cells: {there}" in error
    assert error.count("\n") == 1


def test_cells_of_another_experiment_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "shipped", "--out", str(tmp_path), "--cells", "noise"]) == 2
    assert "--cells: only stability has cells" in capsys.readouterr().err


def test_a_wrong_object_is_never_a_success() -> None:
    """And a filter that converges on it fails silently."""
    level = Level("wrong object", "003_cracker_box", touched="003_cracker_box")
    mug = Setting("025_mug", ring(16), 16)
    cell = stability.cell_of(level, Method("table", "mixture", 100), mug)
    found = cells.play(cell, 0, 6, "", "")
    assert all(map_mm is None for trial in found for map_mm, *_ in trial)
    wrong = TouchResult(math.nan, math.nan, Status.CONVERGED, 100, math.nan)
    flagged = wrong._replace(status=Status.AMBIGUOUS)
    rates = shares({k: [each] for k, each in enumerate((wrong, wrong, flagged, wrong))}, 1)
    assert (rates["success_rate"], rates["flagged_rate"]) == (0.0, 0.25)
    assert rates["silent_failure_rate"] == rates["silent_so_far_rate"] == 0.75


def test_cans_that_a_filter_takes_for_boxes_are_flagged_after_eight_contacts() -> None:
    """Some of a can's contacts agree with a box; of these four trials three ended converged while
    one contradiction asked for no more agreement than many."""
    level = Level("wrong object", "002_master_chef_can", touched="002_master_chef_can")
    box = Setting("003_cracker_box", ring(16), 16)
    found = cells.play(stability.cell_of(level, SHIPPED, box), 1038, 4, "", "")
    last = [Status(trial[-1][2]) for trial in found]
    assert last.count(Status.CONVERGED) <= 1, last


def test_every_factor_has_levels_of_its_own_that_differ() -> None:
    seen = [(level.factor, level.level) for level in LEVELS]
    assert len(set(seen)) == len(seen)
    assert len({repr(level) for level in LEVELS}) == len(LEVELS)
    plain = Level("", 0)
    for level in LEVELS[1:]:
        assert (level.conditions, level.columns, level.particles, level.touched, level.objects) != (
            plain.conditions, plain.columns, plain.particles, plain.touched, plain.objects,
        )  # fmt: skip
    assert LEVELS[0].conditions == Conditions()


def test_every_level_has_a_label_of_its_own() -> None:
    labels = [
        stability_map.label_of({"factor": level.factor, "level": level.level}) for level in LEVELS
    ]
    assert len(set(labels)) == len(labels)


def test_a_map_of_all_levels_is_small(tmp_path: Path) -> None:
    rows = [
        {
            "object": name, "factor": level.factor, "level": level.level,
            "proposal": method.proposal, "injection": method.injection,
            "success_rate": (i % 11) / 10.0, "flagged_rate": 0.3,
            "silent_failure_rate": 0.05 * (i % 3 == 0), "silent_so_far_rate": 0.1, "seeds": 100,
            "success_meant_rate": 0.2,
        }
        for i, level in enumerate(LEVELS)
        for name in level.objects or stability.OBJECTS
        for method in stability.METHODS
    ]  # fmt: skip
    picture, table = tmp_path / "map.png", tmp_path / "map.md"
    stability_map.draw(rows, picture)
    assert 20_000 < picture.stat().st_size < 300_000
    stability_map.table(rows, table)
    text = table.read_text(encoding="utf-8")
    assert "- mug, is a power drill: at best 30%" in text
    assert "- cracker box, touches of two objects: 8, density mixture: " in text
    two = [
        line for line in text.splitlines() if "touches of two objects: 4, density mixture" in line
    ]
    assert two
    assert all(line.endswith(" / 20%") for line in two)  # of the one that is meant
    for name in ("all", "cracker box", "mug"):
        assert f"| density mixture | {name} | " in text
