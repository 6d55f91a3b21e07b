"""Filters that know several objects, run through trials of one: what they say after each touch."""

import hashlib
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from taxeld.estimator.bank import Known
from taxeld.estimator.estimator import Estimator
from taxeld.model.symmetry import add_m
from taxeld.proposals.analytic import Table
from taxeld_training.filters.cells import TOUCHES
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.follow import OWN_SEEDS
from taxeld_training.filters.methods import SHIPPED
from taxeld_training.filters.trials import Trial, TrialScan
from taxeld_training.jobs.identities import UNKNOWN, Identities
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained

TABLED = replace(SHIPPED, proposal=Table.name)


class Recognised(NamedTuple):
    """The estimate after a touch, and what it cost."""

    object: int  # number of the object that the estimate is of
    objects: Sequence[float]  # (K,) probabilities of the known objects
    other: float  # probability of none of them
    map_mm: float  # symmetric ADD of the heaviest mode; nan where another object is touched
    p: float
    radius_mm: float
    cpu_ms: float  # processor time for all scans of the touch
    worst_ms: float  # the longest call of `learn` in it


class Compared(NamedTuple):
    """A touch by a filter of several objects, and by one that knows the touched object alone; None
    where the first does not know it."""

    several: Recognised
    one: Recognised | None


@dataclass(frozen=True)
class Crowd:
    """Trials of an object under a filter of several."""

    known: tuple[Setting, ...]
    touched: Setting
    conditions: TrialConditions

    @property
    def name(self) -> str:
        """Another one for each of a run."""
        digest = hashlib.sha256(repr(self).encode()).hexdigest()[:8]
        return f"{self.touched.name} for {len(self.known)} {digest}"

    @property
    def true(self) -> int:
        """The number of the touched object, or UNKNOWN."""
        return self.known.index(self.touched) if self.touched in self.known else UNKNOWN


def recognise(trial: Sequence[TrialScan], seed: int, known: Sequence[Known]) -> list[Recognised]:
    """The result of each touch of a trial with this seed, `map_mm` as if any object that is named
    were the one that is touched."""
    first, *more = known
    config = TABLED.config(OWN_SEEDS + seed)
    estimator = Estimator(first.model, first.proposal, config, more=more)
    found = []
    for _, moments in groupby(trial, key=lambda moment: moment.touch):
        cpu_s = worst_s = 0.0
        for moment in moments:
            began_s = time.process_time()
            estimator.learn(moment.activation, moment.sensor)
            worst_s = max(worst_s, time.process_time() - began_s)
            estimator.think()
            while estimator.bank.is_behind:
                estimator.think()
            cpu_s += time.process_time() - began_s
        now = estimator.estimate
        error_mm = 1e3 * add_m(known[now.object].model.scene, now.map, moment.truth)[1]
        found.append(
            Recognised(
                now.object,
                now.objects,
                now.hypotheses.other,
                error_mm,
                now.p,
                1e3 * now.radius_m,
                1e3 * cpu_s,
                1e3 * worst_s,
            )
        )
    return found


def play(crowd: Crowd, first: int, count: int) -> list[list[Any]]:
    """Results of the trials of `count` seeds: for each touch a `Compared`."""
    known, true = [known_of(setting) for setting in crowd.known], crowd.true
    model = known_of(crowd.touched).model
    found = []
    for seed in range(first, first + count):
        trial = list(Trial(model, seed, TOUCHES, crowd.conditions))
        several = recognise(trial, seed, known)
        one: Sequence[Recognised | None] = [None] * len(several)
        if true != UNKNOWN:
            one = recognise(trial, seed, [known[true]])
        found.append(
            [
                Compared(_rounded(now, true), alone and _rounded(alone, 0))
                for now, alone in zip(several, one, strict=True)
            ]
        )
    return found


def identities(runs: Sequence[tuple[int, Sequence[Recognised]]]) -> Identities:
    """Runs as (number of the touched object, results of the touches), for their figures."""
    true = np.array([number for number, _ in runs])
    touches = [touches for _, touches in runs]
    named, other, p, error_mm, radius_mm = (
        np.array([[getattr(touch, key) for touch in run] for run in touches])
        for key in ("object", "other", "p", "map_mm", "radius_mm")
    )
    objects = np.array([[touch.objects for touch in run] for run in touches])
    error_mm[named != true[:, None]] = math.nan
    return Identities(p, radius_mm, error_mm, true, named, objects, other)


@lru_cache(maxsize=32)
def known_of(setting: Setting) -> Known:
    """The object of a setting with the table: nothing is trained for this."""
    model = trained.model_of(setting)
    return Known(model, Table(model))


def _rounded(touch: Recognised, true: int) -> Recognised:
    """The touch as it is remembered; `true` is the number of the touched object."""
    return touch._replace(
        objects=[float(f"{share:.6g}") for share in touch.objects],
        other=float(f"{touch.other:.6g}"),
        map_mm=round(touch.map_mm, 4) if touch.object == true else math.nan,
        radius_mm=round(touch.radius_mm, 4),
        cpu_ms=round(touch.cpu_ms, 3),
        worst_ms=round(touch.worst_ms, 3),
    )
