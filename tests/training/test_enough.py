"""Of several filters the first that is shown to be as good as the best is enough."""

import numpy as np

from taxeld_hil.integrity import Claims
from taxeld_training.filters import enough

RNG = np.random.default_rng(0)
HARD = RNG.uniform(0.3, 0.9, 40)  # trials are hard for all filters alike


def test_a_cheap_filter_that_keeps_up_in_every_trial_is_enough() -> None:
    assert enough.first([HARD - 0.2, HARD - 0.005, HARD], usual=2) == 1


def test_what_trials_do_not_tell_apart_leaves_the_usual_filter() -> None:
    noisy = HARD + RNG.normal(0.0, 0.2, 40)
    assert enough.first([noisy, HARD, HARD + 0.3 * (noisy - HARD)], usual=1) == 1


def test_a_dear_filter_is_taken_where_it_is_shown_to_be_better() -> None:
    assert enough.first([HARD - 0.2, HARD, HARD + 0.1], usual=1) == 2


def test_being_sure_and_wrong_once_weighs_more_than_being_sure_earlier() -> None:
    def trials(*each: list[tuple[float, float]]) -> Claims:
        """Of touches as (p, error [mm])."""
        p, error_mm = np.moveaxis(np.array(each), -1, 0)
        return Claims(p, np.full(p.shape, 9.0), error_mm)

    good, doubted, wrong = (1.0, 1.0), (0.5, 1.0), (1.0, 99.0)
    early = trials(*[[good] * 8] * 9, [*[good] * 7, wrong])
    late = trials(*[[doubted, *[good] * 7]] * 10)
    assert enough.worth(early).mean() < enough.worth(late).mean()
