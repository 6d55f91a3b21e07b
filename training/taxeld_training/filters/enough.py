"""Which of several filters is enough: the first that is shown to be as good as the best."""

from collections.abc import Sequence

import numpy as np

from taxeld.arrays import Floats
from taxeld_hil.integrity import Claims
from taxeld_training.jobs.statistics import of_mean

MARGIN = 0.01  # share of the touches by which a filter that is as good may fall behind
LEAST = 40  # trials; fewer choose nothing
MISLED = 10.0  # touches found and sure that one misleading takes away


def worth(of: Claims) -> Floats:
    """(N,) of each trial: the share of its touches after which the object was found and the filter
    sure. A touch after which it was sure and wrong takes `MISLED` of them away."""
    return np.asarray((of.found_and_sure - MISLED * of.misleading).mean(axis=1))


def first(worths: Sequence[Floats], usual: int) -> int:
    """Index of the first filter that is shown to fall behind the best by at most `MARGIN`, of
    filters with worths (T,) in the same trials, T > 1.

    The best is the `usual` one, unless another is shown to be better. It is shown where the
    interval of the paired difference, over trials drawn anew, says so: of what too few trials tell
    apart the usual one is kept.
    """
    rng = np.random.default_rng(0)
    best = max(range(len(worths)), key=lambda k: float(worths[k].mean()))
    if of_mean([worths[best] - worths[usual]], rng)[0] <= 0.0:
        best = usual
    behind = (of_mean([worths[best] - each], rng)[1] for each in worths)
    return next(k for k, most in enumerate(behind) if k == best or most <= MARGIN)
