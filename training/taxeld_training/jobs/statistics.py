"""How sure a figure is: intervals of means and shares, and tests of what was measured in pairs.

Two methods that met the same readings, or the same trials, are compared reading by reading: what a
hard one costs both of them does not hide which is better.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

LEVEL = 0.95
DRAWS = 400  # draws of a bootstrap

Interval = tuple[float, float]


def of_mean(groups: Sequence[ArrayLike], rng: np.random.Generator) -> Interval:
    """Of the mean of the means of groups of values, such as the readings of an object each: a
    group's values are drawn anew among themselves (bootstrap)."""
    drawn = np.zeros(DRAWS)
    for group in groups:
        given = np.asarray(group, dtype=np.float64)
        pick = rng.integers(len(given), size=(DRAWS, len(given)))
        drawn += given[pick].mean(axis=1) / len(groups)
    return _ends(drawn)


def of_median(values: ArrayLike, rng: np.random.Generator) -> Interval:
    """Of the median of values (n,), or of all of (n, m), whose rows are drawn anew as a whole."""
    given = np.asarray(values, dtype=np.float64)
    draws = (given[rng.integers(len(given), size=len(given))] for _ in range(DRAWS // 4))
    return _ends(np.array([np.median(draw) for draw in draws]))


def of_share(rule: Sequence[bool]) -> Interval:
    """Of a share of trials (Wilson): not empty where none, or all, obey the rule."""
    return of_count(sum(map(bool, rule)), len(rule))


def of_count(count: int, total: int) -> Interval:
    """The same of so many of all trials."""
    found = stats.binomtest(count, total).proportion_ci(LEVEL, "wilson")
    return float(found.low), float(found.high)


def p_paired(a: ArrayLike, b: ArrayLike) -> float:
    """Probability that values so different, pair by pair, have one distribution (Wilcoxon)."""
    gap = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    return float(stats.wilcoxon(gap).pvalue) if gap.any() else 1.0


def p_share(a: Sequence[bool], b: Sequence[bool]) -> float:
    """The same of two rules on the same trials (McNemar, exact): only those trials tell that obey
    one of them."""
    first, second = np.asarray(a, dtype=np.bool_), np.asarray(b, dtype=np.bool_)
    won, lost = int((first & ~second).sum()), int((~first & second).sum())
    return float(stats.binomtest(won, won + lost).pvalue) if won + lost else 1.0


def rounded(interval: Interval, digits: int = 4) -> list[float]:
    """As rows have it."""
    return [round(end, digits) for end in interval]


def _ends(drawn: Any) -> Interval:
    low, high = np.quantile(drawn, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return float(low), float(high)
