"""Questions are answered by trials: small runs, which go on after one was cut short."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from taxeld_hil.cli import main as harness
from taxeld_sim.answers import played, questions
from taxeld_sim.answers.questions import Selection
from taxeld_sim.trials.case import Case
from taxeld_sim.trials.play import play
from taxeld_sim.world.subjects import Subject
from taxeld_training import closing
from taxeld_training.cli import main
from taxeld_training.evaluation import run, samplers
from taxeld_training.evaluation.run import Workers

from .rig import RING, written_at

pytestmark = pytest.mark.check


def asked(place: Path, thing: Path | str, *more: str) -> dict[str, list[dict[str, Any]]]:
    """What `evaluate` wrote of an object: rows of answers, and of touches, by question."""
    where = ["--out", str(place / "out"), "--memory", str(place / "memory"), "--workers", "1"]
    assert main(["evaluate", *more, "--quick", "--objects", str(thing), *where]) == 0
    found = {}
    for path in (place / "out").glob("*.json"):
        found[path.stem] = json.loads(path.read_text("utf-8"))["rows"]
        lines = (place / "memory" / f"{path.stem}.jsonl").read_text("utf-8").splitlines()
        found[f"{path.stem} touches"] = [json.loads(line) for line in lines]
    return found


def test_an_answer_goes_on_where_it_was_cut_and_more_seeds_add_to_it(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(played, "BLOCK", 2)
    few = asked(tmp_path, block, "works", "advice", "--cells", "typical,random", "--seeds", "2")
    assert "| block | " in capsys.readouterr().out
    counts = {"works": 3, "works touches": 16, "advice": 3, "advice touches": 16}
    assert {key: len(rows) for key, rows in few.items()} == counts
    head = json.loads((tmp_path / "out" / "works.json").read_text("utf-8"))
    assert {"question", "commit", "command", "date"} < head.keys()
    before = written_at(tmp_path / "memory")
    again = asked(tmp_path, block, "works", "--cells", "typical", "--seeds", "2")
    assert again["works"] == few["works"]
    jobs = {path: at for path, at in before.items() if path.suffix == ".json"}
    assert len(jobs) == 1, "two questions share their trials"
    more = asked(tmp_path, block, "works", "--cells", "typical", "--seeds", "4")
    assert more["works touches"][:16] == few["works touches"]
    assert jobs.items() <= written_at(tmp_path / "memory").items()


def test_expect_build_and_works_have_the_same_figures_of_the_same_trials(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    what = ["--object", block, "--layout", RING, "--foam", "typical", "--seeds", "2"]
    assert harness(["expect", *map(str, (*what, "--out", "told"))]) == 0
    told = json.loads((tmp_path / "told" / "expect.json").read_text("utf-8"))["rows"][0]
    told = {
        key: told[key] for key in ("median_mm", "found", "found_and_sure", "sure", "misleading")
    }
    more = ("works", "--layout", RING, "--cells", "typical", "--seeds", "2")
    (row,) = (row for row in asked(tmp_path, block, *more)["works"] if "object" in row["of"])
    assert told.items() <= row.items()
    out = tmp_path / "built"
    assert main(["build", str(block), "--layout", RING, "--table", "--out", str(out)]) == 0
    own = closing.cell("", closing.case_of([out], RING, "typical"))
    (trials,) = closing.run([own], 2, lambda _: None)
    assert told.items() <= trials.claims.by_touch().items()


def test_guides_are_compared_from_the_same_first_touch(block: Path, tmp_path: Path) -> None:
    few = ("advice", "--cells", "typical,straight,advised", "--seeds", "1", "--layout", RING)
    touches = asked(tmp_path, block, *few)["advice touches"]
    straight, advised = (
        [each for each in touches if each["guide"] == name] for name in ("straight", "advised")
    )
    assert len(straight) == len(advised) == 8
    assert straight[0]["error_mm"] == advised[0]["error_mm"]
    assert all(each["guide_ms"] > 0.0 for each in advised[1:])
    assert not any(each["guide_ms"] for each in straight)


@pytest.mark.parametrize("motion", ["push", "none"])
def test_a_push_follows_its_touches_and_has_the_error_on_its_way(motion: str) -> None:
    *before, last = play(Case((Subject("box"),), guide="push", motion=motion, touches=2), 1)
    assert [math.isnan(touch.path_mm) for touch in (*before, last)] == [True, True, False]


def test_charts_stand_beside_the_rows(block: Path, tmp_path: Path) -> None:
    rows = asked(tmp_path, block, "map", "--cells", "exact,another object", "--seeds", "1")["map"]
    assert {row["of"].get("cell") for row in rows} >= {"exact", "another object"}
    (wrong,) = (row for row in rows if row["of"] == {"cell": "another object"})
    assert (wrong["trials"], wrong["found"]) == (10, [0] * 8)
    asked(tmp_path, block, "whole", "--cells", "table,table 25,table 50", "--seeds", "1")
    for name in ("map", "front"):
        assert 5_000 < (tmp_path / "out" / f"{name}.png").stat().st_size < 300_000


def test_samplers_are_trained_once_and_measured_by_the_exact_posterior(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paper = samplers.LEARNED["paper"]
    assert (paper.training.contacts, paper.frame, paper.view) == (10_000, "pose", "plain")
    few = replace(paper, network=replace(paper.network, steps=2))  # 100 are slow to export
    monkeypatch.setitem(samplers.LEARNED, "paper", few)
    given = questions.load("published", Selection(quick=True, objects=(str(block),)))
    question, workers = replace(given, effort=0.001), Workers(1, tmp_path)
    measured = replace(question, readings=4, columns=(8,), proposals=("table", "paper"))
    apart = Workers(1, tmp_path / "rings")
    table, learned = samplers.rows(measured, apart.memory, apart.run)
    assert table["distance"] < learned["distance"]
    only = Selection(only=("as published",))
    cells = [
        replace(cell, case=replace(cell.case, layouts=(RING,), touches=1))
        for cell in questions.cells(question, only)
    ]

    def error_mm(seed: int) -> float:
        (played,) = run.run(question, cells, Selection(seeds=(seed,)), workers)
        return played.trials[0][0].error_mm

    assert math.isfinite(error_mm(3))
    (model,) = tmp_path.glob("*.onnx")
    written = model.stat().st_mtime_ns
    assert math.isfinite(error_mm(4))
    assert model.stat().st_mtime_ns == written
    model.unlink()  # a model that is lost is trained again
    assert math.isfinite(error_mm(5))
    assert model.is_file()
