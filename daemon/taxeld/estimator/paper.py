"""Algorithm 1 of Marić et al. 2025, kept as the baseline."""

from dataclasses import replace

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import injection
from taxeld.estimator import particles as pf
from taxeld.estimator.evidence import UNTOUCHED
from taxeld.estimator.memory import Memory
from taxeld.estimator.rule import PUSHED_M, Draw, anew, drawn, noise_of
from taxeld.estimator.verdict import placed
from taxeld.model.observation import Lesson, Observation, ObservationModel
from taxeld.model.push import assumed, push
from taxeld.model.symmetry import PoseMetric

INJECTED_DECAY = 0.5  # samples of a contact, of those of the contact before


class Paper:
    """Algorithm 1: samples take the mean weight, and nothing is remembered but the newest scan."""

    def __init__(
        self,
        model: ObservationModel,
        config: FilterConfig,
        robot_m: float,  # noqa: ARG002  (the paper takes poses for exact)
        rng: np.random.Generator,
    ) -> None:
        self._model, self._config, self._rng = model, config, rng
        self._nothing = Memory(model, noise_of(config))
        self.belief = anew(config, rng)
        self.metric = PoseMetric(model.scene)
        self.weighed, self.share = UNTOUCHED, 1.0  # the paper knows no other hypothesis
        self._judge()

    @property
    def is_open(self) -> bool:
        return False  # nothing is remembered

    def follow(self, before: Observation, after: Observation) -> None:
        belief = self.belief
        if not belief.ground.size:
            belief.ground = assumed(len(belief), self._rng)
        model = self._model.links[after.link]
        belief.pose, pushed = push(
            model,
            self.metric,
            belief.pose,
            belief.ground,
            before.sensor,
            after.sensor,
            float(after.z.max()) * model.depth_max_m,
            self._rng,
        )
        if belief.weight @ pushed >= PUSHED_M:
            self._judge()

    def learn(self, observation: Observation, contacts: int, draw: Draw) -> tuple[int, float]:
        samples = drawn(draw, observation, self._wanted(contacts))
        log_evidence = self.update(observation, samples)
        self._judge()
        return len(samples), log_evidence

    def update(self, observation: Observation, samples: Poses) -> float:
        """Learn from a scan and samples (S, 3) of it, without judging the result; → log
        evidence."""
        injection.paper(self.belief, samples)
        memory = self._nothing.plus(replace(observation, place_sd_m=0.0))
        self.belief.remembered = memory.explain(self.belief.pose)
        evidence = pf.reweight(self.belief, self.belief.remembered[:, 0])
        if evidence is None:
            self.belief = anew(self._config, self._rng)
            if len(samples):
                new = pf.equal(samples, np.empty((len(samples), 0)))
                self.belief = pf.resample(new, len(self.belief), self._rng)
            return 0.0
        if pf.resampling_is_due(self.belief):
            self.belief = pf.resample(self.belief, len(self.belief), self._rng)
            pf.roughen(self.belief, self._rng, self.metric.scale)
        return evidence

    def expected(self, _after: int, _link: int) -> Lesson | None:
        return None

    def revisit(self, draw: Draw) -> int:  # noqa: ARG002
        """Nothing is remembered."""
        return 0

    def _judge(self) -> None:
        self.place = placed(self.belief, self.metric, self._config)

    def _wanted(self, contacts: int) -> int:
        """Number of samples. It falls with each contact to nothing: the paper's algorithm sets no
        lower limit, so a belief that settled wrongly stays wrong."""
        config = self._config
        share = INJECTED_DECAY ** max(contacts - 1, 0)
        return min(round(share * config.injected), len(self.belief))
