"""Advice: the approaches that would tell most.

Every line of a fan is judged by how far the link would get; the best of them also by what it would
read (`outcomes`). An approach begins where no hypothesis is near, and the way there on the circle
around them all is free as well, as far as the link reaches it.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.advice import hypotheses, lines
from taxeld.advice.hypotheses import Guesses
from taxeld.advice.lines import Lines, Reach
from taxeld.advice.outcomes import Left, Outcomes
from taxeld.arrays import Floats, Poses
from taxeld.errors import SetupError
from taxeld.estimator.estimate import UNMODELLED_M, Status
from taxeld.estimator.estimator import Estimator

TRIED = 8  # lines that are judged by what would be read
MOST = 3  # approaches of an advice


@dataclass(frozen=True, slots=True)
class Approach:
    """A straight approach of one link. Poses are of its sensor, in the world."""

    link: int
    before: Poses  # (3,) where the approach begins
    at: Poses  # (3,) where contact is expected
    until: Poses  # (3,) where it ends if nothing was touched
    direction: float  # of motion in the world [rad]
    depth_m: float  # to go on once touched
    p_sure: float  # expected probability that the estimate is sure afterwards
    gain: float  # m that it saves beside the mean line: of expected error, and 2 mm for a miss
    p_touch: float  # probability that it touches anything


@dataclass(frozen=True, slots=True)
class Advice:
    """The best approaches after some contacts."""

    contacts: int
    approaches: tuple[Approach, ...]  # best first; none where none is free
    is_enough: bool  # the estimate is sure, and no touch would tell more


class Advisor:
    """Advises by an estimator's belief."""

    def __init__(self, estimator: Estimator, reach: Reach | None = None) -> None:
        """Raises SetupError where the estimator has the paper's rule, which remembers nothing."""
        if estimator.config.injection == "paper":
            raise SetupError("advice: needs the memory of filter.injection = 'mixture'")
        self._estimator, self._reach = estimator, reach or Reach()

    def advise(self) -> Advice:
        """Advice on the present belief."""
        estimator = self._estimator
        contacts = estimator.estimate.contacts
        found = hypotheses.drawn(
            estimator, np.random.default_rng((estimator.config.seed, contacts))
        )
        outcomes = Outcomes(estimator, found)
        links = range(len(estimator.model.links))
        judged = [each for link in links for each in self._judged(found, outcomes, link)]
        judged.sort(key=lambda each: each[0])
        best = tuple(approach for _, approach in judged[:MOST])
        is_sure = estimator.estimate.status == Status.CONVERGED
        # to better an estimate by less than is unmodelled is no reason for a touch
        is_enough = is_sure and (not judged or outcomes.now_m - judged[0][0] < UNMODELLED_M)
        return Advice(contacts, best, is_enough)

    def _judged(self, of: Guesses, outcomes: Outcomes, link: int) -> list[tuple[float, Approach]]:
        """The expected errors that are left, and the approaches, of a link's best lines."""
        free, ways = self.free(self.fan(of, link), of)
        cost = outcomes.by_travel(ways)
        judged = []
        for c in np.argsort(cost)[:TRIED].tolist():
            line = free.only(slice(c, c + 1))
            told = outcomes.by_reading(line, ways[c], self._depth_m(link))
            judged.append((told.cost_m, self._approach(line, ways[c], of, told, cost.mean())))
        return judged

    def fan(self, of: Guesses, link: int) -> Lines:
        """All lines of a link, about the middle of the hypotheses."""
        estimator, reach = self._estimator, self._reach
        centre = np.empty((len(of.weight), 2))
        size = np.empty(len(of.weight))
        for k in of.objects:
            own = of.object == k
            centre[own] = estimator.bank.rules[k].metric.centres(of.pose[own])
            model = estimator.known[k].model.links[link]
            size[own] = model.scene.reach + model.layout.radius_m
        middle = of.weight @ centre
        around_m = float((np.linalg.norm(centre - middle, axis=1) + size).max())
        return lines.fan(
            reach, self._box, estimator.model, link, middle, around_m + reach.clearance_m
        )

    def free(self, some: Lines, of: Guesses) -> tuple[Lines, Floats]:
        """Those of C lines that begin clear of all hypotheses and touch one, and how far the link
        gets on each (F, K)."""
        way = np.empty((len(some), len(of.weight)))
        gap = np.empty_like(way)
        for k in of.objects:
            own, model = of.object == k, self._estimator.known[k].model
            gap[:, own] = lines.gap_before(some, model, of.pose[own])
            way[:, own] = lines.travel(some, model, of.pose[own])
        is_clear = (gap >= self._reach.clearance_m).all(axis=1)
        kept = np.flatnonzero(is_clear & (np.isfinite(way) @ of.weight > 0.0))
        return some.only(kept), way[kept]

    @property
    def _box(self) -> Floats:
        """(2, 2) lower and upper corner of where sensors may be."""
        config, box = self._estimator.config, self._reach.box_m
        if box:
            return np.array(box).reshape(2, 2).T
        corner = np.array(config.centre_m)
        return np.stack([corner - config.half_width_m, corner + config.half_width_m])

    def _depth_m(self, link: int) -> float:
        return min(self._reach.depth_m, self._estimator.model.links[link].depth_max_m)

    def _approach(
        self, line: Lines, way: Floats, of: Guesses, told: Left, mean_m: float
    ) -> Approach:
        touched = np.flatnonzero(np.isfinite(way))
        modes = touched[touched < of.modes]
        at = modes[0] if len(modes) else touched[of.weight[touched].argmax()]
        end = min(float(way[touched].max()) + lines.PAST_M, float(line.length_m[0]))
        before, there, until = line.after_each(np.array([0.0, way[at], end]))
        return Approach(
            line.link,
            before,
            there,
            until,
            float(line.direction[0]),
            self._depth_m(line.link),
            told.sure * (1.0 - self._estimator.estimate.hypotheses.other),
            float(mean_m - told.cost_m),
            float(of.weight[touched].sum()),
        )
