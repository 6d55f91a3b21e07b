"""Two objects touched in turn, in a random order: whether both are found, and told apart."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.estimator import Estimator
from taxeld.model import se2
from taxeld.model.symmetry import add_m
from taxeld_hil import integrity
from taxeld_training.filters.cells import TOUCHES
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.follow import OWN_SEEDS
from taxeld_training.filters.several import TABLED, known_of
from taxeld_training.filters.trials import Trial, TrialScan
from taxeld_training.objects.setting import Setting

APART_M = 0.8  # between the middles of the places that the two may have
BETWEEN_S = 1.0  # time between two touches
OTHER_SEEDS = 2**20  # added to a trial's seed for the second object's touches


class Both(NamedTuple):
    """The estimates after a touch."""

    targets: int  # objects that are said to be there
    worst_mm: float  # symmetric ADD of the worse of the two objects; inf where one is missing
    sure: int  # targets
    misleading: int  # targets


@dataclass(frozen=True)
class Pair:
    """Trials of two objects under a filter that knows both."""

    one: Setting
    other: Setting
    conditions: TrialConditions

    @property
    def name(self) -> str:
        return f"{self.one.name} and {self.other.name} {self.conditions.skin or 'exact'}"


def play(pair: Pair, first: int, count: int) -> list[list[Both]]:
    """Results of the trials of `count` seeds, of each touch; each object has TOUCHES of them."""
    return [_played(pair, seed) for seed in range(first, first + count)]


def _played(pair: Pair, seed: int) -> list[Both]:
    settings = list(dict.fromkeys([pair.one, pair.other]))
    first, *more = (known_of(setting) for setting in settings)
    config = replace(TABLED.config(OWN_SEEDS + seed), half_width_m=APART_M)
    estimator = Estimator(first.model, first.proposal, config, more=more, most=2)
    number = [settings.index(setting) for setting in (pair.one, pair.other)]
    truth: list[Poses | None] = [None, None]
    found = []
    for which, moments in _touches(pair, seed):
        for moment in moments:
            estimator.on_scan(moment.activation, moment.sensor)
        truth[which] = moment.truth
        off_mm = np.full((len(estimator.estimate.targets), 2), np.inf)
        for row, target in zip(off_mm, estimator.estimate.targets, strict=True):
            for k, pose in enumerate(truth):
                if pose is not None and target.object == number[k]:
                    row[k] = (
                        1e3 * add_m(known_of(settings[number[k]]).model.scene, target.map, pose)[1]
                    )
        claimed = np.array([(t.p, 1e3 * t.radius_m) for t in estimator.estimate.targets])
        found.append(_both(off_mm, claimed.reshape(-1, 2)))
    return found


def _both(off_mm: Floats, claimed: Floats) -> Both:
    """`off_mm` (T, 2): of each target from each object; `claimed` (T, 2): its p and radius [mm].
    The nearer object is the one that a target is of."""
    p, radius_mm = claimed.T
    misleading = integrity.is_misleading(p, off_mm.min(axis=1), radius_mm)
    worst_mm, sure = float(off_mm.min(axis=0).max()), integrity.is_sure(p)
    return Both(len(off_mm), round(worst_mm, 4), int(sure.sum()), int(misleading.sum()))


def _touches(pair: Pair, seed: int) -> Iterator[tuple[int, list[TrialScan]]]:
    """The touches, with the number of their object, one after the other in time."""
    away = np.array([APART_M, 0.0, 0.0])
    one, other = (
        groupby(Trial(known_of(setting).model, own, TOUCHES, pair.conditions), lambda m: m.touch)
        for setting, own in ((pair.one, seed), (pair.other, seed + OTHER_SEEDS))
    )
    t = 0.0
    for which in np.random.default_rng((seed, 2)).permutation([0, 1] * TOUCHES).tolist():
        moments = list(next((one, other)[which])[1])
        begun_s = moments[0].activation.t
        placed = []
        for moment in moments:
            activation = replace(moment.activation, t=t + moment.activation.t - begun_s)
            sensor, truth = moment.sensor, moment.truth
            if which:
                sensor, truth = se2.compose(away, sensor), se2.compose(away, truth)
            placed.append(moment._replace(activation=activation, sensor=sensor, truth=truth))
        t = placed[-1].activation.t + BETWEEN_S
        yield which, placed
