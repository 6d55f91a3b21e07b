"""Success does not fall: trials of the question `map` beside those that are kept.

    python -m tests.training.test_success

keeps those of the code as it is, where a change is meant to lower them, or has raised them.
"""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from taxeld.arrays import Floats
from taxeld_sim import jobs
from taxeld_sim.answers import questions
from taxeld_sim.answers.played import played

KEPT = Path(__file__).with_name("success.json")
OBJECTS = "003_cracker_box", "025_mug", "035_power_drill"
CELLS = "exact", "typical", "moved anywhere"
SEEDS = 10
CHANCE = 0.005  # probability of a red row where nothing has changed but what is drawn
FIGURES = "found", "found_and_sure"

Row = dict[str, Any]


def all_tried(memory: Path) -> list[Row]:
    """The trials draw as ever, whatever TAXELD_TEST_SEED is."""
    asked = questions.Selection(objects=OBJECTS, only=CELLS)
    cells = questions.cells(questions.load("map", asked), asked)
    done = played(cells, range(SEEDS), partial(jobs.run, memory=memory))
    return [
        {"object": of.labels["object"], "cell": of.labels["cell"], "seed": seed}
        | {name: getattr(of.claims, name)[seed].astype(int).tolist() for name in FIGURES}
        for of in done
        for seed in of.seeds
    ]


def of_seeds(rows: list[Row], figure: str) -> Floats:
    """(SEEDS,) touches of all objects and cells after which the figure holds."""
    reached = np.zeros(SEEDS)
    for row in rows:
        reached[row["seed"]] += sum(row[figure])
    return reached


def chance(now: Floats, before: Floats) -> float:
    """How likely figures (n,) of seeds fall by so much where their differences from those before
    have either sign alike: the exact test of signs turned."""
    return float(
        stats.permutation_test(
            (now - before,),
            np.mean,
            permutation_type="samples",
            alternative="less",
            n_resamples=np.inf,
        ).pvalue
    )


def test_the_rule_sees_a_fall_and_no_rise() -> None:
    before = np.arange(20.0, 30.0)
    assert chance(before, before) == 1.0
    assert chance(before - 1.0, before) == pytest.approx(0.5**SEEDS)
    assert chance(before + 1.0, before) == 1.0


@pytest.mark.check
def test_as_many_objects_are_found_and_found_for_sure_as_were(tmp_path: Path) -> None:
    rows, before = all_tried(tmp_path), json.loads(KEPT.read_text(encoding="utf-8"))["trials"]
    where = ("object", "cell", "seed")
    assert [[row[k] for k in where] for row in rows] == [[row[k] for k in where] for row in before]
    for figure in FIGURES:
        now, then = of_seeds(rows, figure), of_seeds(before, figure)
        assert chance(now, then) >= CHANCE, f"{figure}: {now} touches of each seed, {then} before"


if __name__ == "__main__":
    jobs.save(KEPT, "trials", all_tried(jobs.MEMORY), {})
