"""Guides of trials that go by the belief: advice on what the robot can reach, or any line of it."""

import time

import numpy as np

from taxeld.advice.advice import TouchMemory, advise
from taxeld.estimator.estimator import Estimator
from taxeld_sim.world.world import World


class BeliefGuide:
    """Guides the touches of one trial by an estimator's belief."""

    def __init__(self, name: str, estimator: Estimator, seed: int) -> None:
        """`name`: straight or advised."""
        self._is_advised, self._memory = name == "advised", TouchMemory(estimator)
        self._rng = np.random.default_rng((seed, 9))

    def lead(self, world: World, t: float) -> float:
        """Have the robot make another touch from scenario time t on; → the processor time of the
        advice [ms]. The first touch is the same under all guides: it finds the object."""
        if not world.touches:
            world.touch(None, t)
            return 0.0
        reached, began_s = world.reached(), time.process_time()
        if self._is_advised:
            world.touch(advise(self._memory, reached)[0].candidate, t)
            return 1e3 * (time.process_time() - began_s)
        world.touch(reached[self._rng.integers(len(reached))], t)
        return 0.0
