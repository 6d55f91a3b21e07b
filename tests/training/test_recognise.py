"""Which of several objects can be told apart, as a build says it."""

import numpy as np
import pytest

from taxeld_training.filters import identities
from taxeld_training.filters.identities import Identities

pytestmark = pytest.mark.check

NAMES = ("box", "mug")


def given(*runs: tuple[int, list[float], float]) -> Identities:
    """Runs as (touched object, probability of object 0 after each touch, p); the rest of the
    probability is object 1's but for a tenth of it. All errors are 5 mm."""
    true = np.array([run[0] for run in runs])
    first = np.array([run[1] for run in runs])
    objects = np.stack([first, 0.9 * (1.0 - first)], axis=2)
    named = objects.argmax(axis=2)
    p = np.array([np.full(len(run[1]), run[2]) for run in runs])
    error_mm = np.where(named == true[:, None], 5.0, np.nan)
    radius_mm = np.full(p.shape, 20.0)
    other = 1.0 - objects.sum(axis=2)
    return Identities(p, radius_mm, error_mm, true, named, objects, other)


def test_a_pair_is_parted_once_the_touched_one_stays_likely_to_the_end() -> None:
    one = given(
        (0, [0.5, 0.999, 0.5, 0.999], 0.5),  # parted after 4: it was in doubt again
        (0, [0.5, 0.999, 0.999, 0.999], 0.5),
        (1, [0.5, 0.5, 0.5, 0.5], 0.5),
        (1, [0.5, 0.5, 0.5, 0.001], 0.5),
    )
    box, mug = identities.parting(one, NAMES)
    assert (box["object"], box["other"], box["median"], box["q90"]) == ("box", "mug", 2, 4)
    assert (box["not_parted"], box["alike"]) == (0.0, False)
    assert (mug["median"], mug["q90"], mug["not_parted"], mug["alike"]) == (4, None, 0.5, True)
