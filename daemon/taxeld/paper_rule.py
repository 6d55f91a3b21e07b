"""Algorithm 1 of Marić et al. 2025, kept as the baseline."""

import numpy as np

from taxeld import consistency, injection
from taxeld import filter as pf
from taxeld.config import FilterConfig
from taxeld.memory import Felt, Memory
from taxeld.observation import ObservationModel
from taxeld.push import push
from taxeld.rule import PUSHED_M, RuleCounters, anew, noise_of
from taxeld.se2 import Poses
from taxeld.symmetry import PoseMetric

SETTLED_SHARE = 0.5  # of S when settled: a wrong belief must find out


class Paper:
    """Algorithm 1: samples take the mean weight, and nothing is remembered but the newest scan."""

    def __init__(self, model: ObservationModel, config: FilterConfig, rng: np.random.Generator):
        self._model, self._config, self._rng = model, config, rng
        self._metric = PoseMetric(model.scene)
        self._noise = noise_of(config)
        self.belief = anew(config, rng)
        self.doubt, self.sure = False, True
        self.counters = RuleCounters()

    def follow(self, before: Felt, after: Felt) -> bool:
        self.belief.pose, pushed = push(
            self._model, self._metric, self.belief.pose, before.sensor, after.sensor,
            float(after.z.max()) * self._model.depth_max_m, self._rng,
        )  # fmt: skip
        return bool(self.belief.weight @ pushed >= PUSHED_M)

    def wanted(self, settled: float) -> int:
        """S falls as the belief settles on one mode."""
        share = max(1.0 - settled, SETTLED_SHARE)
        return min(round(share * self._config.injected), len(self.belief))

    def learn(self, felt: Felt, samples: Poses) -> float:
        injection.paper(self.belief, samples)
        memory = Memory(self._model, self._noise)
        memory.add(felt)
        explained = memory.explain(self.belief.pose)
        evidence = pf.reweight(self.belief, explained[:, 0])
        if evidence is None:
            self.counters.impossible += 1
            self.belief = anew(self._config, self._rng)
            if len(samples):
                drawn = pf.equal(samples, np.empty((len(samples), 0)))
                self.belief = pf.resample(drawn, len(self.belief), self._rng)
            return 0.0
        self.doubt = bool(consistency.lack(memory, self.belief.weight, explained)[0] > 0.0)
        self.counters.inconsistent += self.doubt
        if pf.resampling_is_due(self.belief):
            self.belief = pf.resample(self.belief, len(self.belief), self._rng)
            pf.roughen(self.belief, self._rng)
        return evidence

    def recalled(self) -> Felt | None:
        return None

    def think(self, samples: Poses) -> None:
        """Nothing is recalled."""

    def searched(self, samples: int, *, agreed: bool) -> None:
        """The paper's rule does not ask."""
