"""The tables of docs/physics.md and docs/harness.md are those of the files that they name."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from taxeld_hil.experiment import curves, matrix, physics_experiment, touch_experiment
from taxeld_hil.run import soak_table

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = DOCS / "results"


def touches(path: Path) -> Iterator[str]:
    return touch_experiment.lines(touch_experiment.read(path))


def scenarios(path: Path) -> Iterator[str]:
    return matrix.lines(matrix.read(path))


@pytest.mark.parametrize(
    ("document", "result", "lines"),
    [
        ("physics.md", "curves.json", curves.lines),
        ("physics.md", "physics.json", physics_experiment.lines),
        ("physics.md", "touches_before.json", touches),
        ("physics.md", "touches_foam.json", touches),
        ("physics.md", "touches.json", touches),
        ("physics.md", "touches_poor.json", touches),
        ("harness.md", "scenarios.json", scenarios),
    ],
)
def test_a_table_in_the_documents_is_that_of_the_file_that_it_names(
    document: str, result: str, lines: Callable[[Path], Iterator[str]]
) -> None:
    text = (DOCS / document).read_text(encoding="utf-8")
    assert f"(results/{result})" in text
    assert "\n".join(lines(RESULTS / result)) in text


def test_the_soaks_in_the_documents_are_those_of_their_reports() -> None:
    text = (DOCS / "harness.md").read_text(encoding="utf-8")
    assert "\n".join(soak_table.lines(sorted(RESULTS.glob("soak_typical_*.json")))) in text
