"""Pictures of experiments, from made-up rows in the shape of real ones."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld_training.charts import picture, sampler_charts, trial_charts, whole_chart
from taxeld_training.filters.experiment import STABILITY
from taxeld_training.filters.levels import LEVELS
from taxeld_training.jobs.rows import GRID, trial_table

RESULTS = Path(__file__).parents[2] / "docs" / "results"
OBJECTS = (
    "003_cracker_box",
    "006_mustard_bottle",
    "010_potted_meat_can",
    "019_pitcher_base",
    "025_mug",
    "035_power_drill",
    "061_foam_brick",
)
# distance to the exact posterior as a multiple of the floor
SAMPLERS = {
    ("ddpm", 100, 128): 1.35, ("dpm", 10, 128): 1.9, ("dpm", 4, 128): 3.0,
    ("density", 1, 64): 1.0, ("mdn", 1, 128): 4.5, ("table", None, None): 9.0,
    ("manifold", None, None): 25.0, ("projection", None, None): 110.0,
}  # fmt: skip


def made_rows(objects: tuple[str, ...] = OBJECTS) -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    rows = []
    for name in objects:
        for columns in (16, 32):
            for (proposal, steps, width), gap in SAMPLERS.items():
                add_mm = 25.0 * gap**0.25 * rng.uniform(0.8, 1.25)
                rows.append(
                    {
                        "object": name,
                        "columns": columns,
                        "proposal": proposal,
                        "steps": steps,
                        "width": width,
                        "energy_distance": 0.004 * gap * rng.uniform(0.7, 1.5),
                        "energy_floor": 0.004,
                        "add_mm": {"median": add_mm, "best": 0.2 * add_mm, "worst": 2.1 * add_mm},
                    }
                )
    return rows


def check_picture(path: Path) -> None:
    data = path.read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    assert 5_000 < len(data) < 300_000


def with_gaps(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A sampler that was not run on every object, one that failed, a floor that is missing."""
    kept = [r for r in rows if (r["proposal"], r["object"]) != ("dpm", OBJECTS[0])]
    for row in kept:
        if row["proposal"] == "mdn":
            row["energy_distance"] = math.nan
            row["add_mm"] = {"median": math.nan, "best": None, "worst": math.inf}
        if row["proposal"] == "table":
            row["energy_floor"] = None
    return kept


@pytest.mark.parametrize(
    "rows",
    [made_rows(), with_gaps(made_rows(OBJECTS[:2]))],
    ids=["many", "gaps"],
)
def test_samplers_are_drawn_side_by_side(rows: list[dict[str, Any]], tmp_path: Path) -> None:
    sampler_charts.proposals(rows, tmp_path / "a.png")
    sampler_charts.posterior_gap(rows, tmp_path / "b.png")
    for name in "ab":
        check_picture(tmp_path / f"{name}.png")


@pytest.mark.parametrize("name", ["filter", "stability", "proposals", "whole"])
def test_the_rows_of_the_results_can_be_drawn_again(name: str, tmp_path: Path) -> None:
    """Also those that an earlier version made, with samplers that are no more."""
    rows = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    draw = {
        "filter": trial_charts.by_contact,
        "stability": trial_charts.failures,
        "proposals": sampler_charts.posterior_gap,
        "whole": whole_chart.draw,
    }
    draw[name](rows, tmp_path / "a.png")
    check_picture(tmp_path / "a.png")


def test_a_map_of_all_levels_is_small(tmp_path: Path) -> None:
    rows = [
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
        for name in level.objects or STABILITY.objects
        for method in STABILITY.methods
    ]
    trial_charts.failures(rows, tmp_path / "map.png")
    check_picture(tmp_path / "map.png")
    text = trial_table(rows)
    assert "| mug | wrong object: rubiks cube | density mixture | " in text
    for name in ("all", "cracker box", "mug"):
        assert f"| density mixture | {name} | " in text


def test_the_same_rows_give_the_same_bytes(tmp_path: Path) -> None:
    rows = made_rows(OBJECTS[:1])
    sampler_charts.proposals(rows, tmp_path / "a.png")
    sampler_charts.proposals(rows, tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_samplers_of_one_picture_differ_in_colour_and_not_only_in_their_markers() -> None:
    found = picture.styles(["projection", "manifold", "table", "paper", "density", "exact"])
    assert len({colour for colour, _ in found.values()}) == len(found) == 6


def test_lines_of_the_filters_differ_without_markers() -> None:
    proposals = ("density", "table", "manifold", "projection", "paper", GRID)
    rows = [
        {"proposal": proposal, "injection": injection, "particles": 100, "particles_max": 100}
        for proposal in proposals
        for injection in ("mixture", "paper")
    ]
    found = trial_charts.line_styles(rows)
    assert len(set(map(str, found.values()))) == len(found) == len(rows)
