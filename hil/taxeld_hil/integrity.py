"""What an estimate is worth, held against the truth: the words of all experiments, JSON and pages.

An estimate is *found* where it is of the touched object and its error is under 10 mm, up to the
object's symmetry. It is *sure* where p is 0.99 or more; what is not valid claims nothing and is not
sure. It is *misleading* where it is sure but not found, or sure but farther off than its radius.

Errors are symmetric ADD [mm], not a number where another object is touched; radii are `radius_m`,
in mm. As in satellite navigation, errors against what was claimed make a Stanford diagram.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from taxeld.arrays import Bools, Floats
from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import SURE

FOUND_MM = 1e3 * FilterConfig().within_m
DECADE = 12  # bins of a diagram to a power of ten, on both axes
COUNTS = "estimates", "kept", "beyond", "far", "far_beyond"  # of a diagram
EDGES_MM = 10.0 ** (np.arange(-16, 31) / DECADE)  # 0.05..316; what is beyond is in the end bins


def is_found(error_mm: ArrayLike) -> Bools:
    """Whether estimates with errors (…,) have found the object."""
    return np.asarray(np.less(error_mm, FOUND_MM))


def is_sure(p: ArrayLike) -> Bools:
    """Whether estimates with probabilities (…,) are sure."""
    return np.asarray(np.greater_equal(p, SURE))


def is_beyond(error_mm: ArrayLike, radius_mm: ArrayLike) -> Bools:
    """Whether estimates are farther off than their radius, all (…,), or of another object."""
    return np.asarray(~np.less_equal(error_mm, radius_mm))


def is_misleading(p: ArrayLike, error_mm: ArrayLike, radius_mm: ArrayLike) -> Bools:
    """Whether estimates are sure and not found, or sure and beyond their radius, all (…,)."""
    return is_sure(p) & (~is_found(error_mm) | is_beyond(error_mm, radius_mm))


@dataclass(frozen=True)
class Claims:
    """Estimates (…,), held against the truth."""

    p: Floats
    radius_mm: Floats
    error_mm: Floats  # nan: another object is touched

    @property
    def found(self) -> Bools:
        return is_found(self.error_mm)

    @property
    def sure(self) -> Bools:
        return is_sure(self.p)

    @property
    def misleading(self) -> Bools:
        return is_misleading(self.p, self.error_mm, self.radius_mm)


@dataclass(slots=True)
class Stanford:
    """The counts of a diagram. Only estimates that are sure have a place in it."""

    estimates: int = 0  # sure or not
    kept: int = 0  # found, and within their radius
    beyond: int = 0  # found, but beyond their radius
    far: int = 0  # not found, but within their radius
    far_beyond: int = 0  # neither
    bins: Counter[tuple[int, int]] = field(default_factory=Counter)  # bins of error and of radius

    @property
    def misleading(self) -> int:
        return self.beyond + self.far + self.far_beyond

    @property
    def sure(self) -> int:
        return self.kept + self.misleading

    @property
    def counts(self) -> Floats:
        """(errors, radii) counts between `EDGES_MM`."""
        found = np.zeros((len(EDGES_MM) - 1,) * 2)
        for at, count in self.bins.items():
            found[at] = count
        return found

    def add(self, p: ArrayLike, error_mm: ArrayLike, radius_mm: ArrayLike) -> None:
        """Count estimates (n,)."""
        sure = is_sure(np.atleast_1d(p))
        error, radius = (np.atleast_1d(each)[sure] for each in (error_mm, radius_mm))
        found, beyond = is_found(error), is_beyond(error, radius)
        self.estimates += sure.size
        self.kept += int((found & ~beyond).sum())
        self.beyond += int((found & beyond).sum())
        self.far += int((~found & ~beyond).sum())
        self.far_beyond += int((~found & beyond).sum())
        self.bins.update(zip(_bins(error), _bins(radius), strict=True))

    def include(self, other: "Stanford") -> None:
        """Count the estimates of another diagram."""
        for name in COUNTS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.bins += other.bins

    def row(self) -> dict[str, Any]:
        """The diagram as JSON has it: counts, and bins [error, radius, count]."""
        return {
            **{name: getattr(self, name) for name in ("sure", "misleading", *COUNTS)},
            "bins": [[*at, count] for at, count in sorted(self.bins.items())],
        }

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> "Stanford":
        """The diagram that `row` made a row of."""
        counts = {name: int(row[name]) for name in COUNTS}
        return cls(**counts, bins=Counter({(i, j): n for i, j, n in row["bins"]}))

    @classmethod
    def of_rows(cls, rows: Iterable[Mapping[str, Any]]) -> "Stanford":
        """All the diagrams together."""
        found = cls()
        for row in rows:
            found.include(cls.of_row(row))
        return found


def _bins(values_mm: Floats) -> list[int]:
    at = np.searchsorted(EDGES_MM, values_mm, side="right") - 1  # one that is no number comes last
    return [int(k) for k in np.clip(at, 0, len(EDGES_MM) - 2)]
