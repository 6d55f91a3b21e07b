"""What trials come to: one score for all questions, with intervals over seeds.

*Found*, *sure* and *misleading* are as in `taxeld_sim.integrity`. An estimate of another object
than the touched one has no error and is never found.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import product
from typing import Any, TypeAlias

import numpy as np
from scipy import stats

from taxeld.arrays import Bools, Floats, Index
from taxeld_sim.answers.played import Played, without_nan
from taxeld_sim.integrity import Claims, is_sure

Row: TypeAlias = dict[str, Any]  # {"of": labels, figure: …, "ci": {figure: interval}}

LEVEL = 0.95  # of intervals
DRAWS, WEIGHINGS = 400, 4000  # of seeds, for an interval of a figure, and of a share
BINS = 10  # of p
QUIET = 0.1  # share of the quickest seconds that tell what a quiet machine takes


def rows(played: Sequence[Played], by: Sequence[Sequence[str]]) -> list[Row]:
    """For each list of kinds a row for each combination of the values of these labels."""
    quiet = _quiet_ms(played)
    found = []
    for kinds in by:
        groups: dict[tuple[str, ...], list[Played]] = {}
        for each in played:
            values = (each.labels[kind] for kind in kinds)
            for own in product(*(v if isinstance(v, tuple) else (v,) for v in values)):
                groups.setdefault(own, []).append(each)
        for own, group in groups.items():
            labels = dict(zip(kinds, own, strict=True))
            row = {"of": labels, **figures(group, quiet)}
            known = groups.get(tuple("known" if v == "stranger" else v for v in own), [])
            if "stranger" in own and known:
                row["told_apart"] = told_apart(known, group)
            found.append(row)
    return found


def figures(group: Sequence[Played], quiet: dict[str, float]) -> Row:
    """The figures of all trials of a group."""
    seeds = np.array([seed for each in group for seed in each.seeds])
    p, radius_mm, error_mm = (_all(group, name) for name in ("p", "radius_mm", "error_mm"))
    of = Claims(p, radius_mm, error_mm)
    row: Row = {"seeds": len(set(seeds.tolist())), **of.by_touch()}
    row["to_sure"] = round(float(to_sure(of).mean()), 3)
    ci: Row = {"to_sure": by_seeds(np.mean, to_sure(of), seeds, 3)}
    for name, rule in (("found", of.found), ("found_and_sure", of.found_and_sure)):
        ci[name] = [of_share(after, np.ones(len(after)), seeds) for after in rule.T]
    ci["misleading"] = of_share(of.misleading.sum(axis=1), of.sure.sum(axis=1), seeds)
    row |= {"bins": bins(p.ravel(), of.found.ravel())}
    row["estimates"], row["ece"] = p.size, calibration_error(row["bins"])
    if any(len(each.known) > 1 for each in group):
        row |= _identity(group, of)
    path_mm = _all(group, "path_mm")[:, -1]
    if (felt := np.isfinite(path_mm)).any():  # not every push is
        row["pushes"], path_mm = int(felt.sum()), path_mm[felt]
        row["path_mm"] = np.quantile(path_mm, (0.1, 0.5, 0.9)).round(2).tolist()
        ci["path_mm"] = by_seeds(lambda v: float(np.median(v)), path_mm, seeds[felt], 2)
    spent_ms = np.concatenate([_scaled_ms(each, quiet) for each in group])
    row["ms"] = round(float(np.median(spent_ms)), 3)
    row["ms_at"] = np.median(spent_ms, axis=0).round(3).tolist()
    guided_ms = _all(group, "guide_ms")
    if (guided_ms > 0.0).any():
        row["guide_ms"] = np.quantile(guided_ms[guided_ms > 0.0], (0.5, 0.95)).round(2).tolist()
    return dict(without_nan({**row, "ci": ci}))


def of_share(obeys: Floats, among: Floats, seeds: Index) -> list[float] | None:
    """Interval of the share of `among` (n,) that `obeys` (n,) is, both counts of a trial each, with
    seeds (n,); None of nothing.

    Trials of one seed depend on each other, so each seed is weighed anew, with all its trials (a
    Bayesian bootstrap), beside one mean trial more that has not been seen: all of it obeys for the
    upper end, nothing for the lower. Of one trial a seed that is Clopper and Pearson's interval.
    """
    _, at = np.unique(seeds, return_inverse=True)
    part, all_of = (np.bincount(at, each) for each in (obeys, among))
    if not all_of.any():
        return None
    weight, more = _weights(len(part))
    more = more * all_of.sum() / np.count_nonzero(among)
    obeyed, total = weight @ part, weight @ all_of + more
    low, high = (_middle(of / total) for of in (obeyed, obeyed + more))
    return [low[0], high[1]]


@cache
def _weights(seeds: int) -> tuple[Floats, Floats]:
    """Weights (`WEIGHINGS`, `seeds`) of seeds, and of a trial more (`WEIGHINGS`,)."""
    drawn = np.random.default_rng(0).exponential(size=(WEIGHINGS, seeds + 1))
    return drawn[:, 1:], drawn[:, 0]


def by_seeds(
    figure: Callable[[Floats], float], values: Floats, seeds: Index, digits: int = 4
) -> list[float]:
    """Interval of a figure of trials' values (n,), with seeds (n,) as in `of_share`."""
    rng, (own, at) = np.random.default_rng(0), np.unique(seeds, return_inverse=True)
    of = [np.flatnonzero(at == k) for k in range(len(own))]
    draws = (rng.integers(len(own), size=len(own)) for _ in range(DRAWS))
    drawn = [figure(values[np.concatenate([of[k] for k in draw])]) for draw in draws]
    return _middle(drawn, digits)


def rounded(interval: Iterable[float], digits: int = 4) -> list[float]:
    """An interval as rows have it."""
    return [round(float(end), digits) for end in interval]


def _middle(drawn: Sequence[float] | Floats, digits: int = 4) -> list[float]:
    return rounded(np.quantile(drawn, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL]), digits)


def to_sure(of: Claims) -> Floats:
    """(N,) touches until each trial has found its object for sure; never: all and one more."""
    is_so = of.found_and_sure
    after = np.where(is_so.any(axis=1), is_so.argmax(axis=1), is_so.shape[1])
    return np.asarray(after + 1.0)


def bins(p: Floats, right: Bools) -> list[Row]:
    """The reliability table of probabilities p (n,) of what turned out `right` (n,): a row for each
    of `BINS` equal bins that has any, {from, n, mean_p, right}."""
    told = np.isfinite(p)
    p, right = p[told], right[told]
    at = np.minimum((p * BINS).astype(np.intp), BINS - 1)
    return [
        {
            "from": k / BINS,
            "n": int(mine.sum()),
            "mean_p": round(float(p[mine].mean()), 6),
            "right": round(float(right[mine].mean()), 4),
        }
        for k, mine in ((k, at == k) for k in range(BINS))
        if mine.any()
    ]


def calibration_error(table: Sequence[Row]) -> float | None:
    """Expected calibration error (Naeini et al. 2015): the mean gap between p and the share that
    is right, over the bins of a reliability table, by their counts; None without estimates."""
    total = sum(row["n"] for row in table)
    gap = sum(row["n"] * abs(row["mean_p"] - row["right"]) for row in table)
    return round(gap / total, 4) if total else None


def told_apart(known: Sequence[Played], strangers: Sequence[Played]) -> list[float]:
    """(T,) area under the curve (ROC) of `other` after each touch: how likely it is larger in a
    trial with a stranger than in one with a known object."""
    return _larger(_all(known, "other"), _all(strangers, "other"))


def _larger(one: Floats, two: Floats) -> list[float]:
    """(T,) how likely a figure after each touch is larger in trials two (n, T) than one (m, T)."""
    larger = stats.mannwhitneyu(two, one).statistic / (len(one) * len(two))
    return list(np.round(larger, 4).tolist())


def _identity(group: Sequence[Played], of: Claims) -> Row:
    """Whether the named object is the touched one, and what is named for sure in its place."""
    right = np.concatenate([each.column("named") == each.true for each in group])
    touches = [touch for each in group for trial in each.trials for touch in trial]
    named = np.array([touch.objects[touch.named] for touch in touches])
    second = [(each.true, t.objects[-1]) for each in group for trial in each.trials for t in trial]
    told = {}
    if {len(each.known) for each in group} == {2} and {0, 1} == {k for k, _ in second}:
        shape = -1, len(group[0].trials[0])
        one, two = (np.reshape([p for k, p in second if k == true], shape) for true in (0, 1))
        told["identity"] = _larger(one, two)
    taken = Counter(
        f"{each.labels['object']} for {each.known[int(number)]}"
        for each in group
        for number in each.column("named")[is_sure(each.column("p"))]
        if number != each.true
    )
    return {
        **told,
        "right": right.sum(axis=0).tolist(),
        "object_ece": calibration_error(bins(named, right.ravel())),
        "taken": dict(taken.most_common()),
        "far_and_sure": int((right & of.sure & ~of.found).sum()),
    }


def _quiet_ms(played: Sequence[Played]) -> dict[str, float]:
    """Processor time of a second of scans that tell nothing [ms], where little else runs, for each
    skin and world. What else runs on a machine may double the time of any work, so a touch is timed
    in relation to such scans of its own trial, which are the same work for every filter."""
    found: dict[str, list[float]] = {}
    for each in played:
        idle_ms = each.column("idle_ms")
        found.setdefault(_place(each), []).extend(idle_ms[np.isfinite(idle_ms)].tolist())
    return {key: float(np.quantile(v, QUIET)) if v else math.nan for key, v in found.items()}


def _scaled_ms(each: Played, quiet: dict[str, float]) -> Floats:
    """(N, T) processor time of the touches on a quiet machine; as it was where nothing says."""
    ms, idle_ms = each.column("ms"), each.column("idle_ms")
    if not np.isfinite(idle_ms).any():
        return ms
    return ms * quiet[_place(each)] / np.nanmedian(idle_ms, axis=1, keepdims=True)


def _place(each: Played) -> str:
    return f"{each.labels['cell']}, {each.labels['knows']}"


def _all(group: Sequence[Played], name: str) -> Floats:
    return np.concatenate([each.column(name) for each in group])
