"""Which of several filters is enough: the first that is shown to be as good as the best."""

from collections.abc import Sequence

import numpy as np

from taxeld.arrays import Floats
from taxeld_training.filters.cells import Results
from taxeld_training.jobs.statistics import of_mean

MARGIN = 0.01  # share of the touches by which a filter that is as good may fall behind
MISLED = 10  # touches found and sure that one sure and wrong takes away


def worth(results: Results) -> Floats:
    """(T,) of each trial, by its seed: the share of its touches after which the object was found
    and the filter sure. A touch after which it was sure and wrong takes `MISLED` of them away."""
    return np.array(
        [
            np.mean([t.is_right - MISLED * t.misleads for t in results[seed]])
            for seed in sorted(results)
        ]
    )


def first(worths: Sequence[Floats]) -> int:
    """Index of the first filter that is shown to fall behind the best by at most `MARGIN`, of
    filters with worths (T,) in the same trials.

    It is shown where the interval of the paired difference, over trials drawn anew, says so: what
    too few trials tell apart is not as good.
    """
    best = max(worths, key=lambda each: float(each.mean()))
    rng = np.random.default_rng(0)
    behind = (of_mean([best - each], rng)[1] for each in worths)
    return next(k for k, most in enumerate(behind) if most <= MARGIN or worths[k] is best)
