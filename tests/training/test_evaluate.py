"""The samplers' experiments, small: rows, files, and going on after one was cut short."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh

from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import Projection
from taxeld_training.cli import main
from taxeld_training.jobs.options import Options
from taxeld_training.jobs.rows import DISTANCES, EXACT
from taxeld_training.limits.rivals import LARGE_EPOCHS
from taxeld_training.models.variants import MODELS
from taxeld_training.objects.setting import Setting, ring
from taxeld_training.samplers import evaluate, experiment, runs, trainings
from taxeld_training.samplers.experiment import Measurement

FRONTIER = {
    "object", "columns", "proposal", "steps", "width", "flops", "ms", "ms_eager_ddpm100",
    "speedup", "ms_warm", "ms_eager_ddpm100_warm", "speedup_warm", "energy_distance",
    "energy_floor",
}  # fmt: skip


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "block.stl"
    trimesh.creation.box((0.06, 0.1, 0.1)).export(path)
    return path


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


def test_samplers_of_a_later_run_are_added_to_the_rows_of_an_earlier_one(
    block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    once, twice = tmp_path / "once", tmp_path / "twice"
    assert main(command("proposals", block, once, "--groups", "analytic,density-64")) == 0
    assert main(command("proposals", block, twice, "--groups", "analytic")) == 0
    assert main(command("proposals", block, twice, "--groups", "density-64", "--add")) == 0
    text = [
        (place / "out" / "proposals.json").read_text(encoding="utf-8") for place in (once, twice)
    ]
    assert text[0] == text[1]
    assert main(command("proposals", block, twice, "--groups", "density-64", "--add")) == 0
    assert (twice / "out" / "proposals.json").read_text(encoding="utf-8") == text[0]  # replaced

    rows = json.loads(text[0])
    kept = twice / "out" / "proposals.json"
    capsys.readouterr()
    kept.write_text(json.dumps([row | {"energy_floor": 1.0} for row in rows]), encoding="utf-8")
    assert main(command("proposals", block, twice, "--groups", "density-64", "--add")) == 2
    assert "are of other readings" in capsys.readouterr().err
    for row in rows:
        del row[DISTANCES]
    kept.write_text(json.dumps(rows), encoding="utf-8")
    assert main(command("proposals", block, twice, "--groups", "density-64", "--add")) == 2
    assert f"--add: {kept} has rows without distances" in capsys.readouterr().err
    assert main(command("stability", block, twice, "--add")) == 2
    assert "only rows of proposals and frontier" in capsys.readouterr().err


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


def test_the_gallery_is_drawn(block: Path, tmp_path: Path) -> None:
    assert main(command("gallery", block, tmp_path)) == 0
    assert (tmp_path / "out" / "gallery.png").stat().st_size > 10_000


def test_damage_is_measured_on_the_shipped_bundles(tmp_path: Path) -> None:
    place = ["--out", str(tmp_path), "--memory", str(tmp_path / "memory"), "--workers", "1"]
    assert main(["evaluate", "damage", "--quick", *place]) == 0
    rows = json.loads((tmp_path / "damage.json").read_text(encoding="utf-8"))
    assert {row["dead_share"] for row in rows} == {0.0, 0.1}
    assert {row["proposal"] for row in rows} == {"density", "ddpm", "table", "manifold"}
    assert (tmp_path / "damage.png").is_file()


def test_without_time_only_remembered_rows_are_written(block: Path, tmp_path: Path) -> None:
    groups = ("--groups", "analytic")
    assert main(command("proposals", block, tmp_path, *groups)) == 0
    more = ("--groups", "analytic,density-16", "--minutes", "0")
    assert main(command("proposals", block, tmp_path, *more)) == 0
    rows = json.loads((tmp_path / "out" / "proposals.json").read_text(encoding="utf-8"))
    assert {row["proposal"] for row in rows} == {
        "projection", "manifold", "table", EXACT,
    }  # fmt: skip


def test_an_unknown_group_or_object_is_refused_in_one_line(
    block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command("proposals", block, tmp_path, "--groups", "magic")) == 2
    assert "--groups: no 'magic'" in capsys.readouterr().err
    assert main(command("proposals", Path("999_none"), tmp_path)) == 2
    assert "999_none" in capsys.readouterr().err


def test_measurements_with_other_counts_are_other_jobs() -> None:
    one = Measurement("a", ring(8), 8)
    other = Measurement("a", ring(8), 8, readings=9)
    assert repr(one) != repr(other)
    assert one.name == other.name == "a-8"


def test_every_sampler_of_the_results_has_a_command(block: Path, tmp_path: Path) -> None:
    """Also those not run before: the generator, and rivals with the density's contacts."""
    wanted = {"generator-128", "diffusion-128", "paper", "table-1e5", "npe-3e5", "fmpe-3e5", "npse"}
    assert wanted <= set(experiment.GROUPS["frontier"])
    assert experiment.COLUMNS == (8, 16, 32, 64)
    out = command("proposals", block, tmp_path, "--groups", "analytic", "--skin", ring(4))
    assert main(out) == 0
    names = {path.name for path in (tmp_path / "out").iterdir() if path.suffix == ".json"}
    assert len(names) == 1
    assert "proposals.json" not in names  # rows of another skin do not stand in the rings' place


def test_a_large_rival_has_the_densitys_number_of_contacts(
    monkeypatch: pytest.MonkeyPatch, ring_model: ObservationModel
) -> None:
    asked = []

    def train(kind: str, *_: object, **more: int) -> Projection:
        asked.append((kind, more.get("contacts"), more.get("max_epochs")))
        return Projection(ring_model)

    monkeypatch.setattr(experiment, "train_rival", train)
    setting = Measurement("a", ring(16), 16)
    for group in ("fmpe", "fmpe-3e5"):
        (tried,) = experiment.samplers_of(setting, group, None, ring_model)
        assert tried.proposal == group
    assert asked == [("fmpe", None, None), ("fmpe", 300_000, LARGE_EPOCHS["fmpe"])]
    assert MODELS["density-64"].training.contacts == 300_000
