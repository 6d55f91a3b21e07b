"""What an estimate is worth, held against the truth: the words of all experiments, JSON and pages.

An estimate is *found* where it is of the touched object and its error is under 10 mm, up to the
object's symmetry. It is *sure* where p is 0.99 or more; what is not valid claims nothing and is not
sure. It is *misleading* where it is sure but not found, or sure but farther off than its radius.

Errors are symmetric ADD [mm], not a number where another object is touched; radii are `radius_m`,
in mm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from taxeld.arrays import Bools, Floats
from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import SURE

FOUND_MM = 1e3 * FilterConfig().within_m
NEAR_MM = 20.0


def is_found(error_mm: ArrayLike) -> Bools:
    """Whether estimates with errors (…,) have found the object."""
    return np.asarray(np.less(error_mm, FOUND_MM))


def is_sure(p: ArrayLike) -> Bools:
    """Whether estimates with probabilities (…,) are sure."""
    return np.asarray(np.greater_equal(p, SURE))


def is_misleading(p: ArrayLike, error_mm: ArrayLike, radius_mm: ArrayLike) -> Bools:
    """Whether estimates are sure and not found, or sure and beyond their radius, all (…,)."""
    return is_sure(p) & ~(is_found(error_mm) & np.less_equal(error_mm, radius_mm))


@dataclass(frozen=True)
class Claims:
    """Estimates (…,), held against the truth."""

    p: Floats
    radius_mm: Floats
    error_mm: Floats  # nan: another object is touched

    @classmethod
    def of_trials(cls, trials: Sequence[Sequence[Any]]) -> Self:
        """Those of N trials after T touches each (N, T), each with its p, radius and error."""
        rows = [[(one.p, one.radius_mm, one.error_mm) for one in trial] for trial in trials]
        return cls(*np.moveaxis(np.array(rows, dtype=np.float64), -1, 0))

    @property
    def found(self) -> Bools:
        return is_found(self.error_mm)

    @property
    def sure(self) -> Bools:
        return is_sure(self.p)

    @property
    def found_and_sure(self) -> Bools:
        return self.found & self.sure

    @property
    def misleading(self) -> Bools:
        return is_misleading(self.p, self.error_mm, self.radius_mm)

    def by_touch(self) -> dict[str, Any]:
        """Of trials (N, T): quantiles of the error after each touch, and how many are then found,
        found and sure, near, within their radius, or misleading; and how many estimates of all are
        sure, and mislead."""
        median, most = np.quantile(self.error_mm, (0.5, 0.9), axis=0).round(2).tolist()
        return {
            "trials": len(self.p),
            "median_mm": median,
            "q90_mm": most,
            "found": self.found.sum(axis=0).tolist(),
            "found_and_sure": self.found_and_sure.sum(axis=0).tolist(),
            "near": (self.error_mm < NEAR_MM).sum(axis=0).tolist(),
            "covered": (self.error_mm <= self.radius_mm).sum(axis=0).tolist(),
            "misleading_at": self.misleading.sum(axis=0).tolist(),
            "sure": int(self.sure.sum()),
            "misleading": int(self.misleading.sum()),
        }
