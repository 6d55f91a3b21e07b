"""Which object is felt, held against the truth: figures of filters that know several objects.

The object of an estimate is *right* where it is the one that is touched. It is *found*, *sure* and
*misleading* as in `taxeld_hil.integrity`. `other` is the probability that it is none of the known
objects.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from taxeld.arrays import Bools, Floats, Index
from taxeld_hil.integrity import Claims
from taxeld_hil.trials.play import Touch

UNKNOWN = -1  # `true` of a run whose object the filter does not know
PARTED = 0.99  # probability of the touched object, were there but one other, that parts the two
ALIKE = 0.5  # share of runs that leave two objects together, from which they are alike


@dataclass(frozen=True)
class Identities(Claims):
    """Estimates of N runs of T touches each, by a filter that knows K objects. The claims (N, T)
    are of the object of each estimate."""

    true: Index  # (N,) number of the touched object, or UNKNOWN
    named: Index  # (N, T) number of the object of the estimate
    objects: Floats  # (N, T, K) probabilities of the known objects
    other: Floats  # (N, T) probability of none of them

    @classmethod
    def of(cls, runs: Sequence[tuple[int, Sequence[Touch]]]) -> "Identities":
        """Runs as (number of the touched object, results of the touches)."""
        named, p, error_mm, radius_mm, objects, other = (
            np.array([[getattr(touch, key) for touch in run] for _, run in runs])
            for key in ("object", "p", "error_mm", "radius_mm", "objects", "other")
        )
        true = np.array([number for number, _ in runs])
        return cls(p, radius_mm, error_mm, true, named, objects, other)

    def __len__(self) -> int:
        return len(self.true)

    def only(self, kept: Bools) -> "Identities":
        """The runs in `kept` (N,)."""
        return Identities(*(getattr(self, field.name)[kept] for field in fields(self)))

    @property
    def known(self) -> Bools:
        """(N,) whether the filter knows the touched object."""
        return np.asarray(self.true != UNKNOWN)

    @property
    def right(self) -> Bools:
        return np.asarray(self.named == self.true[:, None])

    @property
    def of_named(self) -> Floats:
        """(N, T) probability of the object of the estimate."""
        return np.asarray(np.take_along_axis(self.objects, self.named[..., None], 2)[..., 0])

    @property
    def of_true(self) -> Floats:
        """(N, T) probability of the touched object, all of which must be known."""
        return np.asarray(np.take_along_axis(self.objects, self.true[:, None, None], 2)[..., 0])


def parting(given: Identities, names: Sequence[str]) -> list[dict[str, Any]]:
    """How many touches part each known object, where it is touched, from each other one: rows
    {object, other, median, q90, not_parted, alike, trials}. A run parts two once the touched one
    has a probability of `PARTED`, were there but these two, to the end; null: not by then."""
    touches = given.p.shape[1]
    found = []
    for true, name in enumerate(names):
        mine = given.objects[given.true == true]
        for k, other in enumerate(names):
            if k == true or not len(mine):
                continue
            both = mine[..., true] + mine[..., k]
            apart = mine[..., true] >= PARTED * both
            stays = np.logical_and.accumulate(apart[:, ::-1], axis=1)
            parted_after = touches - stays.sum(axis=1) + 1  # touches + 1: never
            left = float((parted_after > touches).mean())
            found.append(
                {
                    "object": name,
                    "other": other,
                    **{
                        key: int(count) if count <= touches else None
                        for key, count in zip(
                            ("median", "q90"),
                            np.quantile(parted_after, [0.5, 0.9], method="inverted_cdf").tolist(),
                            strict=True,
                        )
                    },
                    "not_parted": round(left, 4),
                    "alike": left >= ALIKE,
                    "trials": len(mine),
                }
            )
    return found
