"""The tables of docs/physics.md and docs/harness.md are those of the files that they name."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from taxeld_hil.experiment import matrix, touches
from taxeld_hil.experiment.measurement import RunRow, read
from taxeld_hil.run import soak

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = DOCS / "results"


@pytest.mark.parametrize(
    ("document", "result", "lines"),
    [
        ("physics.md", "touches.json", touches.lines),
        ("physics.md", "touches_poor.json", touches.lines),
        ("harness.md", "scenarios.json", matrix.lines),
    ],
)
def test_a_table_in_the_documents_is_that_of_the_file_that_it_names(
    document: str, result: str, lines: Callable[[Sequence[RunRow]], Iterator[str]]
) -> None:
    text = (DOCS / document).read_text(encoding="utf-8")
    assert f"(results/{result})" in text
    assert "\n".join(lines(read(RESULTS / result))) in text


def test_the_soaks_in_the_documents_are_those_of_their_reports() -> None:
    text = (DOCS / "harness.md").read_text(encoding="utf-8")
    assert "\n".join(soak.table(sorted(RESULTS.glob("soak_typical_*.json")))) in text
