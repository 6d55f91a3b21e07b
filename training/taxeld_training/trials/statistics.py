"""How sure a figure is: its interval by a bootstrap, or by the number of trials."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from taxeld.arrays import Floats, Index

LEVEL = 0.95
DRAWS = 400  # draws of a bootstrap

Interval = tuple[float, float]


def of_count(count: int, total: int) -> Interval:
    """Interval (Wilson) of the share that `count` of `total` trials are: not empty where none, or
    all, are."""
    found = stats.binomtest(count, total).proportion_ci(LEVEL, "wilson")
    return float(found.low), float(found.high)


def of_share(obeys: ArrayLike, among: ArrayLike, seeds: Index) -> Interval | None:
    """Interval of the share of `among` (n,) that `obeys` (n,) is, both counts of a trial each, with
    seeds (n,); None of nothing.

    Trials of one seed depend on each other, so seeds are drawn anew, each with all its trials. The
    shares none and all have no spread: there each seed counts as one trial.
    """
    _, at = np.unique(seeds, return_inverse=True)
    part, all_of = (np.bincount(at, np.asarray(each, dtype=np.float64)) for each in (obeys, among))
    if not all_of.sum():
        return None
    if part.sum() in (0.0, all_of.sum()):
        total = int((all_of > 0.0).sum())
        return of_count(total if part.sum() else 0, total)
    pick = np.random.default_rng(0).integers(len(part), size=(DRAWS, len(part)))
    drawn_of = all_of[pick].sum(axis=1)
    return _ends((part[pick].sum(axis=1) / np.maximum(drawn_of, 1.0))[drawn_of > 0.0])


def by_seeds(figure: Callable[[Floats], float], values: Floats, seeds: Index) -> Interval:
    """Interval of a figure of trials' values (n,), with seeds (n,) as in `of_share`."""
    rng, (own, at) = np.random.default_rng(0), np.unique(seeds, return_inverse=True)
    of = [np.flatnonzero(at == k) for k in range(len(own))]
    draws = (rng.integers(len(own), size=len(own)) for _ in range(DRAWS))
    return _ends([figure(values[np.concatenate([of[k] for k in draw])]) for draw in draws])


def rounded(interval: Interval, digits: int = 4) -> list[float]:
    """An interval as rows have it."""
    return [round(end, digits) for end in interval]


def _ends(drawn: Sequence[float] | Floats) -> Interval:
    low, high = np.quantile(drawn, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return float(low), float(high)
