"""What estimates promise, and whether they keep it: `p` and `radius_m` held against the truth.

`p` is the probability that an estimate is *found*. What is *sure* and *misleading* is as in
`taxeld_hil.integrity`. Shares of estimates have no interval: those of one trial depend on each
other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from taxeld.arrays import Bools, Floats, Index
from taxeld_hil.integrity import Claims

BINS = 10
CONTACTS = (4, 6, 8)  # contacts with shares of their own


@dataclass(frozen=True)
class Promises(Claims):
    """Estimates (N,), each after a contact of a run."""

    contact: Index  # counted from 1

    def __len__(self) -> int:
        return len(self.p)

    @property
    def of_object(self) -> Bools:
        """Whether the object is the one that the filter assumes."""
        return np.isfinite(self.error_mm)


def reliability(p: Floats, right: Bools) -> list[dict[str, Any]]:
    """The reliability table of probabilities p (N,) of what turned out `right` (N,): a row for each
    of `BINS` equal bins that has any, {from, n, mean_p, right}."""
    at = np.minimum((p * BINS).astype(np.intp), BINS - 1)
    return [
        {
            "from": k / BINS,
            "n": int(mine.sum()),
            "mean_p": round(float(p[mine].mean()), 6),
            "right": rate(right[mine]),
        }
        for k, mine in ((k, at == k) for k in range(BINS))
        if mine.any()
    ]


def calibration_error(table: Sequence[dict[str, Any]]) -> float | None:
    """Expected calibration error (Naeini et al. 2015): the mean gap between p and the share that
    is right, over the bins of a reliability table, by their counts; None without estimates."""
    total = sum(row["n"] for row in table)
    gap = sum(row["n"] * abs(row["mean_p"] - row["right"]) for row in table)
    return round(gap / total, 4) if total else None


def kept(given: Promises) -> dict[str, Any]:
    """Figures of estimates: the calibration of p, and how many of those that are sure mislead; of
    runs with the object that the filter assumes, the shares that are found and sure, and that
    mislead, after `CONTACTS`."""
    found, sure, misleading = given.found, given.sure, given.misleading
    radius_mm = given.radius_mm[sure]
    after = {k: given.of_object & (given.contact == k) for k in CONTACTS}
    return {
        "estimates": len(given),
        "ece": calibration_error(reliability(given.p, found)),
        "sure": int(sure.sum()),
        "misleading": int(misleading.sum()),
        "misleading_rate": rate(misleading[sure]),
        "radius_mm": round(float(np.median(radius_mm)), 3) if len(radius_mm) else None,
        **{f"found_and_sure_{k}": rate((found & sure)[mine]) for k, mine in after.items()},
        **{f"misleading_{k}": rate(misleading[mine]) for k, mine in after.items()},
    }


def rate(rule: Bools) -> float | None:
    """The share of estimates that obey a rule (N,); None without any."""
    return round(float(rule.mean()), 4) if len(rule) else None
