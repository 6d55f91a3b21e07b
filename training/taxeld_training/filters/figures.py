"""What rows say of trials: shares and errors, their intervals, and tests against another method."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from taxeld_training.filters.cells import Results
from taxeld_training.filters.methods import TouchResult
from taxeld_training.jobs.rows import SUCCESS_MM
from taxeld_training.jobs.statistics import of_median, of_share, p_share, rounded


def shares(results: Results, contact: int) -> dict[str, float | list[float] | None]:
    """Shares of trials that by a contact, counted from 1, had succeeded, were flagged and failed
    silently, at it or at any up to it; the last three are None for a filter without a status. Each
    `_ci` is the interval of the figure before it.

    Where another object is touched than the filter assumes no trial succeeds, and one that
    converged failed silently. Where two of a kind are touched either counts, but for
    `success_meant_rate`.
    """
    trials = [trial[:contact] for trial in results.values()]
    last = [trial[-1] for trial in trials]
    has_status = last[0].status is not None
    return {
        **_share("success", [result.succeeded for result in last]),
        "success_meant_rate": _rate([result.meant_mm < SUCCESS_MM for result in last]),
        "flagged_rate": _rate([not r.converged for r in last]) if has_status else None,
        **_share("silent_failure", [r.failed_silently for r in last] if has_status else []),
        **_share(
            "silent_so_far",
            [any(r.failed_silently for r in trial) for trial in trials] if has_status else [],
        ),
    }


def against(mine: Results, shipped: Results | None, contact: int) -> dict[str, float | int | None]:
    """A method beside the one that ships, after a contact of the trials that both have: how many
    each alone found, how many neither, and how likely chance alone parts them so far. None where
    what ships was not run."""
    if shipped is None:
        return dict.fromkeys(("found_alone", "shipped_alone", "neither", "p_shipped"))
    seeds = sorted(mine.keys() & shipped.keys())
    found = [mine[seed][contact - 1].succeeded for seed in seeds]
    theirs = [shipped[seed][contact - 1].succeeded for seed in seeds]
    pairs = list(zip(found, theirs, strict=True))
    return {
        "found_alone": pairs.count((True, False)),
        "shipped_alone": pairs.count((False, True)),
        "neither": pairs.count((False, False)),
        "p_shipped": round(p_share(found, theirs), 6),
    }


def errors(results: Sequence[TouchResult], key: str) -> dict[str, Any]:
    """Quantiles of an error [mm] over trials, and the interval of the median; None where a trial
    has no error, as of a wrong object."""
    values = [getattr(result, key) for result in results]
    if not np.isfinite(values).all():
        return {key: dict.fromkeys(("q10", "median", "q90")), f"{key}_ci": None}
    interval = rounded(of_median(values, np.random.default_rng(0)), 3)
    return {key: quantiles(values), f"{key}_ci": interval}


def quantiles(values: Sequence[float], digits: int = 3) -> dict[str, float]:
    """As the rows of experiments have them."""
    low, median, high = np.quantile(values, [0.1, 0.5, 0.9]).tolist()
    return {"q10": round(low, digits), "median": round(median, digits), "q90": round(high, digits)}


def _share(name: str, rule: Sequence[bool]) -> dict[str, float | list[float] | None]:
    """Of trials that obey a rule, with its interval; None of no trials."""
    if not rule:
        return {f"{name}_rate": None, f"{name}_ci": None}
    return {f"{name}_rate": _rate(rule), f"{name}_ci": rounded(of_share(rule))}


def _rate(rule: Sequence[bool]) -> float:
    return round(sum(rule) / len(rule), 4)
