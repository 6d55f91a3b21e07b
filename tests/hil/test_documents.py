"""Tables in docs/results are those of the files that they name."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from taxeld_hil.experiment import matrix, touches
from taxeld_hil.experiment.measurement import RunRow, read
from taxeld_hil.run import soak

RESULTS = Path(__file__).parents[2] / "docs" / "results"


@pytest.mark.parametrize(
    ("document", "result", "lines"),
    [
        ("touches.md", "touches.json", touches.lines),
        ("touches.md", "touches_poor.json", touches.lines),
        ("scenarios.md", "scenarios.json", matrix.lines),
        ("layouts.md", "layouts.json", matrix.lines),
    ],
)
def test_a_table_in_the_documents_is_that_of_the_file_that_it_names(
    document: str, result: str, lines: Callable[[Sequence[RunRow]], Iterator[str]]
) -> None:
    text = (RESULTS / document).read_text(encoding="utf-8")
    assert f"{result})" in text
    assert "\n".join(lines(read(RESULTS / result))) in text


def test_the_soaks_in_the_documents_are_those_of_their_reports() -> None:
    text = (RESULTS / "soaks.md").read_text(encoding="utf-8")
    made = "\n".join(soak.table(sorted(RESULTS.glob("soak_typical_*.json"))))
    assert made.replace("](results/", "](") in text
