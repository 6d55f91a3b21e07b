"""The file of questions: which trials answer one, and what is refused."""

import re
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from taxeld_sim import jobs
from taxeld_sim.answers import charts, questions, tables
from taxeld_sim.answers.questions import Cell, Selection
from taxeld_training.cli import QUESTIONS, main
from taxeld_training.evaluation import run
from tests.rig.commands import refused, refuses

BOX, _ = questions.listed("two")
OTHER = "cylinder:rows=2,columns=8,radius_m=0.05,pitch_m=0.015"


WORKS = "exact", "typical", "poor", "robot 2 mm"
ALL = Selection()


def cells(name: str, asked: Selection = ALL) -> list[Cell]:
    return questions.cells(questions.load(name, asked), asked)


def test_every_question_can_be_asked_and_no_two_of_its_cells_are_the_same_trials() -> None:
    assert ", ".join(questions.names()) == QUESTIONS
    for name in questions.names(recorded=False):
        question = questions.load(name, ALL)
        if not question.cells:  # samplers are not tried, but measured
            continue
        assert max(Counter(repr(cell.case) for cell in cells(name)).values()) == 1
        assert set().union(*question.by) <= {*cells(name)[0].labels}


def test_no_object_is_taken_for_itself_and_strangers_are_unknown() -> None:
    for cell in (*cells("map"), *cells("which")):
        known = cell.case.known
        touched = cell.case.touched or known[0]
        if cell.labels["knows"] == "one":
            assert touched not in known or cell.labels["touched"] == "known"
        else:
            assert (touched in known) == (cell.labels["touched"] == "known")


def test_what_the_filter_was_tuned_on_is_fixed() -> None:
    """The other half tells what a user will meet."""
    new = {str(c.labels["cell"]) for c in cells("map") if "not tuned" in c.labels["part"]}
    assert {name.partition(",")[0].partition(" ")[0] for name in new} == {
        "another",
        "depth",
        "object",
        "pitch",
        "radius",
    }
    assert all(
        "not tuned" in c.labels["part"] for c in cells("map", Selection(objects=("016_pear",)))
    )
    wrong = [c for c in cells("map") if c.case.touched]
    assert all("another object" in c.labels["part"] for c in wrong)
    assert not any("soft skin" in c.labels["part"] for c in wrong)


MOVED = {"moved 2 mm", "moved 5 mm", "moved 25 mm", "moved anywhere"}
ON_OTHER = {f"{foam} on {OTHER}" for foam in questions.FOAMS}


@pytest.mark.parametrize(
    ("name", "asked", "kind", "found"),
    [
        ("map", Selection(only=("moved", "poor")), "cell", {"poor", *MOVED}),
        ("map", Selection(quick=True, only=("moved", "poor")), "cell", {"poor", *MOVED}),
        ("map", Selection(only=("moved 5 mm",)), "cell", {"moved 5 mm"}),
        ("map", Selection(only=("symmetric",)), "cell", {"symmetric"}),
        ("map", Selection(objects=(BOX,)), "object", {BOX}),
        ("whole", Selection(only=("density", "table 25")), "method", {"density", "table 25"}),
        ("advice", Selection(only=("advised", "typical")), "guide", {"advised"}),
        ("advice", Selection(only=("advised", "typical")), "cell", {"typical"}),
        ("works", Selection(layouts=(OTHER,)), "cell", ON_OTHER),
        ("works", Selection(layouts=("", OTHER)), "cell", {*WORKS, *ON_OTHER}),
    ],
)
def test_trials_are_chosen_by_what_is_named(
    name: str, asked: Selection, kind: str, found: set[str]
) -> None:
    """A cell by its whole name or its first word; a layout has a cell on each foam."""
    chosen = cells(name, asked)
    assert {cell.labels[kind] for cell in chosen} == found
    assert all((cell.labels["cell"] in ON_OTHER) == (OTHER in cell.case.layouts) for cell in chosen)


def test_objects_of_ones_own_are_the_only_ones_that_a_filter_knows() -> None:
    assert {len(c.case.known) for c in cells("which", Selection(objects=(BOX,)))} == {1}


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ("magic", f"QUESTION: no 'magic'; there are {QUESTIONS}"),
        ("works --objects 999_none", "999_none: no such YCB object"),
        ("map --cells noise,sniff", "--cells: no 'sniff' here; there are exact, typical, poor, "),
        ("push --cells noise", "no 'noise' here; there are exact, table, push, push, none"),
        (f"map --cells moved --layout {OTHER}", "--layout: goes with the cells exact, typical, po"),
        ("works --seeds 9-8", "--seeds: must be a number of them, or FIRST-LAST, not '9-8'"),
        ("works --workers 0", "--workers must be at least 1"),
    ],
)
def test_what_there_is_not_is_refused_in_one_line_that_says_what_there_is(
    arguments: str, fault: str, tmp_path: Path
) -> None:
    place = ["--out", str(tmp_path), "--memory", str(tmp_path), "--quick"]
    assert fault in refused("evaluate", *arguments.split(" "), *place, main=main)


ROOT = Path(__file__).parents[2]


def row(found: list[int], misleading: int = 0, **of: str) -> tables.Row:
    made: tables.Row = {"of": of, "trials": 40, "found": found, "misleading": misleading}
    made |= {"sure": 30, "median_mm": [4.04, 0.2], "q90_mm": [9.0, 1.0], "ece": 0.0345}
    ci = {"found": [[0.1, 0.4], [0.839, 1.0]], "misleading": [0.0, 0.161], "ece": [0.01, 0.05]}
    return made | {"ci": ci}


ROWS = [
    row([10, 40], object="003_cracker_box", cell="exact"),
    row([1, 39], object="003_cracker_box", cell="poor"),
    row([0, 20], 2, object="025_mug", cell="exact"),
    row([5, 30], 2, cell="exact"),
]


@pytest.mark.parametrize(
    ("spec", "table"),
    [
        (
            "cell=exact | object | mm 1 2 | found 2 | misleading | all",
            """
| object | mm after 1 | mm after 2 | found 2 | misleading |
|---|---|---|---|---|
| cracker box | 4.0 (9) | 0.2 (1) | 100 % | 0 of 30 |
| mug | 4.0 (9) | 0.2 (1) | 50 % | 2 of 30 |
| all | 4.0 (9) | 0.2 (1) | 75 % | 2 of 30 |""",
        ),
        (
            "object | found 1 2 by cell",
            """
| object | exact, found 1 2 | poor, found 1 2 |
|---|---|---|
| cracker box | 25 / 100 % | 2 / 98 % |
| mug | 0 / 50 % |  |""",
        ),
        (
            "cell=poor | object | found± 2 | misleading± | ece± | absent",
            """
| object | found 2 | misleading | error of p | absent |
|---|---|---|---|---|
| cracker box | 98 % (84–100 %) | 0 of 30 (0.0–16 %) | 0.0345 (0.01–0.05) |  |""",
        ),
    ],
)
def test_a_table_has_a_line_a_value_and_columns_of_figures_by_touch_or_label(
    spec: str, table: str
) -> None:
    assert tables.text(ROWS, spec) == table.strip()


def test_an_error_that_is_not_known_leaves_its_cell_empty() -> None:
    unknown = row([0, 1], object="mug") | {"median_mm": [None, 0.2], "q90_mm": [None, 1.0]}
    assert tables.text([unknown], "object | mm 1 2").endswith("| mug |  | 0.2 (1) |")


def test_a_share_is_never_rounded_to_all_or_none() -> None:
    shares = [tables.share(count, 1000) for count in (0, 1, 4, 996, 999, 1000)]
    assert shares == ["0 %", "1 %", "1 %", "99 %", "99 %", "100 %"]


def test_pages_hold_what_their_rows_say_or_are_filled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tables.main([]) == 0, "a page of this tree and its rows disagree"
    monkeypatch.setattr(tables, "DOCS", tmp_path)
    jobs.save(tmp_path / "results" / "mine.json", "rows", ROWS, {"commit": "x"})
    block = "<!-- figures: mine | cell=exact | object | found 2 -->\n{}<!-- end -->\n"
    page = tmp_path / "page.md"
    page.write_text("a\n" + block.format("old\n") + "b\n" + block.format(""), encoding="utf-8")
    assert tables.main([]) == 1
    assert capsys.readouterr().err.endswith("page.md: not what its rows say; --write fills it\n")
    assert tables.main(["--write"]) == tables.main([]) == 0
    made = tables.text(ROWS, "cell=exact | object | found 2")
    both = (block.format(f"{made}\n"), block.format(f"{made}\n"))
    assert page.read_text("utf-8") == f"a\n{both[0]}b\n{both[1]}"


def test_a_file_that_cannot_be_written_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("", encoding="ascii")
    refuses("--out: cannot write", jobs.save, tmp_path / "out" / "x.json", "rows", [], {})


def figures(**of: str) -> tables.Row:
    made: dict[str, Any] = {"ms": 10.0 + len(str(of)), "to_sure": 4.0, "trials": 40, "sure": 9}
    made |= {"misleading": 1, "found_and_sure": [0, 30]}
    return {"of": of, **made, "ci": {"to_sure": [3.5, 4.5], "found_and_sure": [[0, 1], [0.6, 0.9]]}}


@pytest.mark.parametrize("name", sorted(charts.CHARTS))
def test_charts_are_small_and_drawn_again_with_the_same_bytes(name: str, tmp_path: Path) -> None:
    methods, cells = (questions.table()[key] for key in ("methods", "cells"))
    rows = [figures(cell="exact", method=each) for each in methods]
    rows += [figures(cell="exact", method=each, object="025_mug") for each in methods]
    rows += [figures(cell=each, object=name) for each in cells for name in ("025_mug", "016_pear")]
    for out in ("a.png", "b.png"):
        charts.CHARTS[name](rows, tmp_path / out)
    data = (tmp_path / "a.png").read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    assert 5_000 < len(data) < 300_000
    assert data == (tmp_path / "b.png").read_bytes()


def test_a_file_names_its_commit_which_answers_in_docs_do_not_change_and_is_old_once_the_belief_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*words: str) -> None:
        person = ("-c", "user.name=taxeld", "-c", "user.email=taxeld@example.org")
        subprocess.run(["git", "-C", str(tmp_path), *person, *words], check=True)

    (tmp_path / "docs").mkdir()
    for name in ("code.py", "docs/map.json"):
        (tmp_path / name).write_text("1", "utf-8")
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "Begin")
    clean = run.commit(tmp_path)
    assert re.fullmatch("[0-9a-f]{8}", clean)
    (tmp_path / "docs" / "map.json").write_text("2", "utf-8")
    assert run.commit(tmp_path) == clean
    (tmp_path / "code.py").write_text("2", "utf-8")
    assert run.commit(tmp_path) == f"{clean}-dirty"
    monkeypatch.setattr(tables, "DOCS", tmp_path / "docs")
    jobs.save(tmp_path / "docs" / "results" / "map.json", "rows", [], {"commit": f"{clean}-dirty"})
    for changed, lines in (
        ("tests", []),
        ("daemon/taxeld/skin", [f"map.json: of {clean}"]),
    ):
        (tmp_path / changed).mkdir(parents=True)
        (tmp_path / changed / "x.py").write_text("3", "utf-8")
        git("add", ".")
        git("commit", "-qm", "Change it")
        assert [line.partition(";")[0] for line in tables.older()] == lines
