"""Pictures of experiments, from the rows of the results."""

import json
from pathlib import Path
from typing import Any

import pytest

from taxeld_training import charts
from taxeld_training.filters.reliability import CURVES

RESULTS = Path(__file__).parents[2] / "docs" / "results"


def rows_of(name: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return [row for row in rows if "reliability" not in name or row.get("over") in CURVES]


@pytest.mark.parametrize(
    ("name", "draw"),
    [
        ("stability", charts.failures),
        ("whole", charts.front),
        ("reliability", charts.reliability),
    ],
)
def test_the_pictures_of_the_results_are_small_and_drawn_again_with_the_same_bytes(
    name: str, draw: Any, tmp_path: Path
) -> None:
    for out in ("a.png", "b.png"):
        draw(rows_of(name), tmp_path / out)
    data = (tmp_path / "a.png").read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    assert 5_000 < len(data) < 300_000
    assert data == (tmp_path / "b.png").read_bytes()
