"""Tables in docs/results are those of the files that they name."""

import json
from pathlib import Path

import pytest

from taxeld_hil.experiment import matrix

RESULTS = Path(__file__).parents[2] / "docs" / "results"


@pytest.mark.parametrize("name", ["scenarios", "layouts"])
def test_a_table_in_the_documents_is_that_of_the_file_that_it_names(name: str) -> None:
    text = (RESULTS / f"{name}.md").read_text(encoding="utf-8")
    assert f"{name}.json)" in text
    runs = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))["runs"]
    assert "\n".join(matrix.lines(runs)) in text
