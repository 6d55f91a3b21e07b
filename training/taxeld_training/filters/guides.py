"""Guides of trials: who says where the next touch is made. All but `any` know the belief alone."""

import time

import numpy as np

from taxeld.advice import hypotheses
from taxeld.advice.advice import Advisor, Approach
from taxeld.advice.lines import PAST_M, Lines, Reach
from taxeld.arrays import Floats
from taxeld.estimator.estimator import Estimator

ANY = "any"  # presses that know where the object is, from a random side
RANDOM = "random"  # any line of those that advice chooses from
ADVICE = "advice"
GUIDES = (ANY, RANDOM, ADVICE)


class Guide:
    """Guides the touches of one trial by an estimator's belief."""

    def __init__(self, name: str, estimator: Estimator, seed: int) -> None:
        """`name`: of `GUIDES`."""
        self._name, self._estimator = name, estimator
        self._advisor = Advisor(estimator)
        self._rng = np.random.default_rng((seed, 9))
        self.costs_ms: list[float] = []  # processor time of each advice

    def __call__(self, touch: int) -> Approach | None:
        """The first touch is the same under all guides: it finds the object."""
        if touch == 0 or self._name == ANY:
            return None
        return self._line() if self._name == RANDOM else self._advised()

    def _advised(self) -> Approach | None:
        began_s = time.process_time()
        advice = self._advisor.advise()
        self.costs_ms.append(1e3 * (time.process_time() - began_s))
        return advice.approaches[0] if advice.approaches else None

    def _line(self) -> Approach | None:
        found = hypotheses.drawn(self._estimator, self._rng)
        fan = self._advisor.fan(found, 0)
        free, ways = self._advisor.free(fan, found)
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
