"""One score: shares, intervals over seeds, calibration, identity and cost."""

import json
import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy import stats

from taxeld_sim.answers import score
from taxeld_sim.answers.questions import Cell
from taxeld_sim.answers.score import Played
from taxeld_sim.trials.case import Case
from taxeld_sim.trials.play import Touch
from taxeld_sim.world.subjects import Subject

BOX, MUG, CAN = (Subject(name) for name in ("box", "mug", "can"))
LABELS = {"object": "box", "cell": "exact", "knows": "one", "touched": "known"}


def touch(error_mm: float = 1.0, p: float = 1.0, **given: object) -> Touch:
    plain = Touch(0, error_mm, p, 5.0, (1.0,), 0.0, 0.0, "converged", 100, 2.0, 1.0, 0.0)
    return plain._replace(**given)


GOOD, FAR, DOUBTED, WRONG = touch(), touch(99.0), touch(1.0, 0.5), touch(math.nan)


def played(*trials: Sequence[Touch], first: int = 0, **labels: str | tuple[str, ...]) -> Played:
    cell = Cell({**LABELS, **labels}, Case((BOX,)))
    return Played.of(cell, range(first, first + len(trials)), trials)


def row(*group: Played) -> score.Row:
    (found,) = score.rows(group, [[]])
    return found


@pytest.mark.parametrize(
    ("trials", "figures"),
    [
        (
            [[DOUBTED, GOOD, GOOD], [GOOD, FAR, GOOD]],
            {"trials": 2, "seeds": 2, "found": [2, 1, 2], "found_and_sure": [1, 1, 2], "sure": 5}
            | {"misleading": 1, "misleading_at": [0, 1, 0], "to_sure": 1.5},
        ),
        (
            [[touch(6.0, 0.99), touch(5.0, 1.0), touch(10.0, 0.995, radius_mm=20.0)]],
            {"misleading_at": [1, 0, 1]},
        ),
        (
            [[WRONG, WRONG._replace(p=0.5)]],
            # JSON has no nan; never: one touch more than there are
            {"found": [0, 0], "misleading_at": [1, 0], "median_mm": [None, None], "to_sure": 3.0},
        ),
        (
            [[touch(1.0, math.nan, radius_mm=math.nan)] * 2],
            {"found": [1, 1], "sure": 0, "ece": None},
        ),
    ],
    ids=[
        "shares are of trials after each touch",
        "sure and beyond its radius misleads and exactly at it does not",
        "another object is never found and misleads where the filter is sure",
        "without p a filter is never sure and has no calibration",
    ],
)
def test_trials_are_counted_after_each_touch(
    trials: list[list[Touch]], figures: dict[str, object]
) -> None:
    found = row(played(*trials))
    assert {key: found[key] for key in figures} == figures
    assert (found["ci"]["misleading"] is None) == (found["sure"] == 0)
    json.dumps(found, allow_nan=False)


def test_intervals_are_over_seeds_and_one_seed_in_many_cells_is_no_more_trials() -> None:
    rng = np.random.default_rng(0)
    trials = [[GOOD if good else FAR] for good in rng.random(40) < 0.7]
    once = row(played(*trials))
    many = row(*(played(*trials, cell=str(k)) for k in range(5)))
    apart = row(*(played(*trials, cell=str(k), first=100 * k) for k in range(5)))
    assert many["trials"] == apart["trials"] == 200
    width = [np.ptp(each["ci"]["found"][0]) for each in (once, many, apart)]
    assert width[1] == pytest.approx(width[0], abs=0.04)
    assert width[2] < 0.7 * width[0]
    low, high = once["ci"]["found"][0]
    assert low < once["found"][0] / 40 < high


def test_of_one_trial_a_seed_an_interval_is_clopper_and_pearsons_and_leaps_nowhere() -> None:
    ends = []
    for count in range(21):
        of_seed = (np.arange(20) < count).astype(float)
        ends.append(score.of_share(of_seed, np.ones(20), np.arange(20)))
        exact = stats.binomtest(count, 20).proportion_ci(0.95, "exact")
        assert ends[-1] == pytest.approx([exact.low, exact.high], abs=0.02)
    steps = np.diff(ends, axis=0)
    assert (steps >= 0.0).all()
    assert steps.max() < 2.0 / 20.0
    assert score.of_share(np.zeros(20), np.zeros(20), np.arange(20)) is None


@pytest.mark.parametrize("share", [0.002, 0.01, 0.1, 0.6])
def test_nineteen_of_twenty_intervals_hold_the_share_also_where_hardly_any_trial_obeys(
    share: float,
) -> None:
    """Of 40 seeds with ten trials each, each with as many sure estimates as it happens to have, all
    of them right or all wrong; seeds differ in how likely that is."""
    rng, seeds, held, runs = np.random.default_rng(0), np.repeat(np.arange(40), 10), 0, 300
    for _ in range(runs):
        own = rng.beta(20.0 * share, 20.0 * (1.0 - share), 40)
        sure = rng.integers(0, 9, 400).astype(float)
        low, high = score.of_share(sure * (rng.random(400) < own[seeds]), sure, seeds) or (1, 0)
        held += low <= share <= high
    assert held / runs > 0.9


def test_an_interval_of_a_mean_is_that_of_its_standard_error() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(5.0, 2.0, 400)
    low, high = score.by_seeds(lambda each: float(each.mean()), values, np.arange(400))
    assert (low + high) / 2 == pytest.approx(values.mean(), abs=0.05)
    assert high - low == pytest.approx(2 * 1.96 * 2.0 / 20.0, rel=0.2)


def test_the_calibration_error_is_the_gap_between_p_and_the_share_that_is_right() -> None:
    p = np.array([0.95] * 10 + [0.25] * 4 + [0.05] * 2)
    right = np.array([True] * 8 + [False] * 2 + [True] + [False] * 3 + [True] * 2)
    table = score.bins(p, right)
    assert [(each["from"], each["n"], each["mean_p"], each["right"]) for each in table] == [
        (0.0, 2, 0.05, 1.0),
        (0.2, 4, 0.25, 0.25),
        (0.9, 10, 0.95, 0.8),
    ]
    expected = (2 * 0.95 + 4 * 0.0 + 10 * 0.15) / 16
    assert score.calibration_error(table) == pytest.approx(expected, abs=1e-4)
    assert score.calibration_error([]) is None
    edges = score.bins(np.array([0.0, 0.1, 0.19, 0.9, 1.0]), np.zeros(5, dtype=np.bool_))
    assert [(each["from"], each["n"]) for each in edges] == [(0.0, 1), (0.1, 2), (0.9, 2)]


def test_rows_are_by_labels_and_a_label_of_several_values_counts_in_each() -> None:
    cells = [
        played([GOOD], part=("all", "tuned")),
        played([FAR], part=("all", "not tuned"), object="mug"),
    ]
    found = score.rows(cells, [["object"], ["part"], []])
    assert [(each["of"], each["found"]) for each in found] == [
        ({"object": "box"}, [1]),
        ({"object": "mug"}, [0]),
        ({"part": "all"}, [1]),
        ({"part": "tuned"}, [1]),
        ({"part": "not tuned"}, [0]),
        ({}, [1]),
    ]


def known(*trials: Sequence[Touch], touched: Subject = BOX) -> Played:
    """Trials of a filter that knows box and mug."""
    case = Case((BOX, MUG), touched)
    kind = "known" if touched in case.known else "stranger"
    labels = {**LABELS, "knows": "two", "touched": kind, "object": touched.name}
    return Played.of(Cell(labels, case), range(len(trials)), trials)


def test_the_named_object_is_right_where_it_is_touched_and_strangers_stand_out_by_other() -> None:
    box = touch(objects=(0.9, 0.05), other=0.05)
    taken = touch(math.nan, objects=(0.05, 0.9), other=0.05, named=1)
    strange = touch(math.nan, 0.999, objects=(0.1, 0.0), other=0.9)
    group = [known([box, taken], [box, box]), known([strange, box], touched=CAN)]
    mine, strangers = score.rows(group, [["touched"]])
    assert (mine["right"], mine["found"], mine["trials"]) == ([2, 1], [2, 1], 2)
    assert mine["taken"] == {"box for mug": 1}
    assert mine["object_ece"] == pytest.approx(0.9 - 3 / 4)
    assert strangers["taken"] == {"can for box": 2}
    assert strangers["told_apart"] == [1.0, 0.5]
    far = score.rows([known([touch(10.1, objects=(1.0, 0.0))])], [[]])[0]
    assert (far["right"], far["found"], far["far_and_sure"]) == ([1], [0], 1)


def test_a_touch_is_timed_by_quiet_scans_of_its_own_trial() -> None:
    """A machine that is twice as slow for a while changes nothing."""
    slow = touch(ms=4.0, idle_ms=2.0)
    assert row(played(*[[GOOD]] * 9, [slow]))["ms"] == 2.0
    assert row(played([slow], [GOOD]))["ms_at"] == [pytest.approx(2.0, rel=0.2)]
    assert row(played([touch(idle_ms=math.nan)]))["ms"] == 2.0  # as it was


def test_a_push_has_the_error_over_its_path_and_advice_its_cost() -> None:
    felt = (*map(float, range(11)), math.nan)  # the last push was not felt
    ends = [touch(path_mm=mm, guide_ms=30.0) for mm in felt]
    found = row(played(*([GOOD, end] for end in ends)))
    assert found["path_mm"] == [1.0, 5.0, 9.0]
    assert found["ci"]["path_mm"][0] < 5.0 < found["ci"]["path_mm"][1]
    assert found["guide_ms"] == [30.0, 30.0]
    assert "path_mm" not in row(played([GOOD]))


def test_every_touch_is_kept_as_a_row_of_its_own() -> None:
    rows = list(played([GOOD, touch(math.nan)], [FAR, GOOD], first=7).records())
    assert [(each["seed"], each["touch"]) for each in rows] == [(7, 1), (7, 2), (8, 1), (8, 2)]
    assert {*LABELS, *Touch._fields, "known"} <= rows[0].keys()
    assert (rows[0]["error_mm"], rows[1]["error_mm"]) == (1.0, None)
    json.dumps(rows, allow_nan=False)


def test_a_record_of_a_touch_has_the_touched_object_and_the_named_one() -> None:
    (record,) = played([GOOD], object="mug").records()
    assert (record["object"], record["named"]) == ("mug", GOOD.named)
