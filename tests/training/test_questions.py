"""The file of questions: which trials answer one, and what is refused."""

from collections import Counter
from pathlib import Path

import pytest

from taxeld_sim.answers import questions
from taxeld_sim.answers.questions import Cell, Selection
from taxeld_training.cli import QUESTIONS, main
from tests.rig.commands import refused

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
        counts = Counter(repr(cell.case) for cell in cells(name))
        assert max(counts.values()) == 1
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
