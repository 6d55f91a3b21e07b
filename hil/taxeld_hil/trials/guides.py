"""Guides of trials that go by the belief: advice, or any straight line of those it chooses from."""

import time

import numpy as np

from taxeld.advice import hypotheses
from taxeld.advice.advice import Advisor, Approach
from taxeld.advice.lines import PAST_M, Lines, Reach
from taxeld.arrays import Floats
from taxeld.estimator.estimator import Estimator
from taxeld_hil.world.world import World


class BeliefGuide:
    """Guides the touches of one trial by an estimator's belief."""

    def __init__(self, name: str, estimator: Estimator, seed: int) -> None:
        """`name`: straight or advised."""
        self._is_advised, self._estimator = name == "advised", estimator
        self._advisor = Advisor(estimator)
        self._rng = np.random.default_rng((seed, 9))

    def lead(self, world: World, t: float) -> float:
        """Have the robot make another touch from scenario time t on; → the processor time of the
        advice [ms]. The first touch is the same under all guides: it finds the object."""
        if not world.touches:
            world.touch(None, t)
            return 0.0
        began_s = time.process_time()
        approach = self._advised() if self._is_advised else self._line()
        spent_ms = 1e3 * (time.process_time() - began_s)
        world.touch(approach, t)
        return spent_ms if self._is_advised else 0.0

    def _advised(self) -> Approach | None:
        advice = self._advisor.advise()
        return advice.approaches[0] if advice.approaches else None

    def _line(self) -> Approach | None:
        found = hypotheses.drawn(self._estimator, self._rng)
        free, ways = self._advisor.free(self._advisor.fan(found, 0), found)
        if not len(free):
            return None
        at = int(self._rng.integers(len(free)))
        return _approach(free.only(slice(at, at + 1)), ways[at])


def _approach(line: Lines, way: Floats) -> Approach:
    """An approach on a single line that hypotheses are touched on after `way` (K,)."""
    touched = way[np.isfinite(way)]
    end = min(float(touched.max()) + PAST_M, float(line.length_m[0]))
    before, at, until = line.after_each(np.array([0.0, float(touched.min()), end]))
    depth_m, direction = Reach().depth_m, float(line.direction[0])
    return Approach(line.link, before, at, until, direction, depth_m, 0.0, 0.0, 0.0)
