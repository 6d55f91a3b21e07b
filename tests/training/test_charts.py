"""Pictures of experiments, from made-up rows in the shape of real ones."""

import json
from pathlib import Path
from typing import Any

import pytest

from taxeld_training.charts import map_chart, picture, whole_chart
from taxeld_training.filters.levels import LEVELS
from taxeld_training.filters.stability import METHODS, OBJECTS

RESULTS = Path(__file__).parents[2] / "docs" / "results"


def check_picture(path: Path) -> None:
    data = path.read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    assert 5_000 < len(data) < 300_000


@pytest.mark.parametrize("name", ["stability", "whole"])
def test_the_rows_of_the_results_can_be_drawn_again(name: str, tmp_path: Path) -> None:
    rows = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    draw = {"stability": map_chart.draw, "whole": whole_chart.draw}
    draw[name](rows, tmp_path / "a.png")
    check_picture(tmp_path / "a.png")


def map_rows() -> list[dict[str, Any]]:
    return [
        {
            "object": name,
            "factor": level.factor,
            "level": level.level,
            "contact": 8,
            "proposal": method.proposal,
            "injection": method.injection,
            "found_rate": (i % 11) / 10.0,
            "found_ci": [0.0, 1.0],
            "sure_rate": 0.7,
            "misleading_rate": 0.05 * (i % 3 == 0),
            "misleading_so_far_rate": 0.1,
            "seeds": 100,
            "map_mm": {"median": 1.0},
        }
        for i, level in enumerate(LEVELS)
        for name in level.objects or OBJECTS
        for method in METHODS
    ]


@pytest.mark.check
def test_a_map_of_all_levels_is_small_and_the_same_rows_give_the_same_bytes(tmp_path: Path) -> None:
    rows = map_rows()
    map_chart.draw(rows, tmp_path / "map.png")
    map_chart.draw(rows, tmp_path / "again.png")
    assert (tmp_path / "map.png").read_bytes() == (tmp_path / "again.png").read_bytes()
    check_picture(tmp_path / "map.png")


def test_samplers_of_one_picture_differ_in_colour_and_not_only_in_their_markers() -> None:
    found = picture.styles(["projection", "manifold", "table", "paper", "density"])
    assert len({colour for colour, _ in found.values()}) == len(found) == 5
