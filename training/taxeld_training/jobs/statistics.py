"""How sure a figure is: intervals of means and shares, and tests of what was measured in pairs.

Two methods that met the same readings, or the same trials, are compared reading by reading: what a
hard one costs both of them does not hide which is better.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from taxeld.arrays import Floats

LEVEL = 0.95
DRAWS = 400  # draws of a bootstrap

Interval = tuple[float, float]


def of_mean(groups: Sequence[ArrayLike], rng: np.random.Generator) -> Interval:
    """Interval of the mean of the means of groups of values (n,), such as the readings of an object
    each: a group's values are drawn anew among themselves (bootstrap)."""
    drawn = np.zeros(DRAWS)
    for group in groups:
        given = np.asarray(group, dtype=np.float64)
        pick = rng.integers(len(given), size=(DRAWS, len(given)))
        drawn += given[pick].mean(axis=1) / len(groups)
    return _ends(drawn)


def of_median(values: ArrayLike, rng: np.random.Generator) -> Interval:
    """Interval of the median of values (n,), or of all of (n, m), whose rows are drawn anew as a
    whole."""
    given = np.asarray(values, dtype=np.float64)
    draws = (given[rng.integers(len(given), size=len(given))] for _ in range(DRAWS // 4))
    return _ends([float(np.median(draw)) for draw in draws])


def share(name: str, rule: ArrayLike, end: str = "") -> dict[str, Any]:
    """How many of all obey a rule (n,), with the Wilson interval, as rows have it; None without
    any."""
    obeys = np.asarray(rule, dtype=np.bool_)
    if not len(obeys):
        return {f"{name}{end}": None, f"{name}_ci": None}
    interval = rounded(of_count(int(obeys.sum()), len(obeys)))
    return {f"{name}{end}": round(float(obeys.mean()), 4), f"{name}_ci": interval}


def of_count(count: int, total: int) -> Interval:
    """Interval (Wilson) of the share that `count` of `total` trials are: not empty where none, or
    all, are."""
    found = stats.binomtest(count, total).proportion_ci(LEVEL, "wilson")
    return float(found.low), float(found.high)


def p_share(a: Sequence[bool], b: Sequence[bool]) -> float:
    """Probability that two rules so different on the same trials are obeyed as often (McNemar,
    exact): only trials that obey one of them count."""
    first, second = np.asarray(a, dtype=np.bool_), np.asarray(b, dtype=np.bool_)
    won, lost = int((first & ~second).sum()), int((~first & second).sum())
    return float(stats.binomtest(won, won + lost).pvalue) if won + lost else 1.0


def quantiles(values: Sequence[float], digits: int = 3) -> dict[str, float]:
    """Median and tenths, as rows have them."""
    low, median, high = np.quantile(values, [0.1, 0.5, 0.9]).tolist()
    return {"q10": round(low, digits), "median": round(median, digits), "q90": round(high, digits)}


def rounded(interval: Interval, digits: int = 4) -> list[float]:
    """An interval as rows have it."""
    return [round(end, digits) for end in interval]


def _ends(drawn: Sequence[float] | Floats) -> Interval:
    low, high = np.quantile(drawn, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return float(low), float(high)
