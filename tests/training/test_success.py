"""Success does not fall: trials of the question `works` beside those that are kept.

    python -m tests.training.test_success

keeps those of the code as it is, where a change is meant to lower them, or has raised them.
"""

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from taxeld.arrays import Floats
from taxeld_sim import jobs
from taxeld_sim.answers import questions
from taxeld_sim.integrity import Claims
from taxeld_sim.trials.case import Case
from taxeld_sim.trials.play import play

KEPT = Path(__file__).with_name("success.json")
OBJECTS, CELLS = ("003_cracker_box", "025_mug", "035_power_drill"), ("exact", "typical")
SEEDS = 10
CHANCE = 0.005  # probability of a red row where nothing has changed but what is drawn
FIGURES = "found", "found_and_sure"

Row = dict[str, Any]


@cache
def cases() -> list[tuple[str, str, Case]]:
    asked = questions.Selection(objects=OBJECTS, only=CELLS)
    cells = questions.cells(questions.load("works", asked), asked)
    return [(str(c.labels["object"]), str(c.labels["cell"]), c.case) for c in cells]


def tried(_: None, which: tuple[int, int]) -> Row:
    """A trial in a process of its own, which draws as ever, whatever TAXELD_TEST_SEED is."""
    number, seed = which
    thing, cell, case = cases()[number]
    of = Claims.of_trials([play(case, seed)])
    reached = {name: getattr(of, name)[0].astype(int).tolist() for name in FIGURES}
    return {"object": thing, "cell": cell, "seed": seed, **reached}


def all_tried() -> Iterator[Row]:
    of_all = [(number, seed) for number in range(len(cases())) for seed in range(SEEDS)]
    return jobs.beside(tried, None, of_all, workers=2)


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
def test_as_many_objects_are_found_and_found_for_sure_as_were() -> None:
    rows, before = list(all_tried()), json.loads(KEPT.read_text(encoding="utf-8"))["trials"]
    where = ("object", "cell", "seed")
    assert [[row[k] for k in where] for row in rows] == [[row[k] for k in where] for row in before]
    for figure in FIGURES:
        now, then = of_seeds(rows, figure), of_seeds(before, figure)
        assert chance(now, then) >= CHANCE, f"{figure}: {now} touches of each seed, {then} before"


if __name__ == "__main__":
    jobs.save(KEPT, "trials", list(all_tried()), {})
