"""Algorithm 1 of Marić et al. 2025, kept as the baseline."""

from dataclasses import replace

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.memory import Memory
from taxeld.estimator.mixture import Draw, Mixture
from taxeld.estimator.particles import Belief
from taxeld.estimator.scans import ScanEvidence
from taxeld.model.observation import ObservationModel
from taxeld.prior import PosePrior

INJECTED_DECAY = 0.5  # samples of a contact, of those of the contact before


class Paper(Mixture):
    """Algorithm 1: samples take the mean weight, and nothing is remembered but the newest scan. No
    hypothesis is known but that the object stands."""

    def __init__(
        self,
        model: ObservationModel,
        config: FilterConfig,
        robot_m: float,
        rng: np.random.Generator,
        draw: Draw,
    ) -> None:
        super().__init__(model, config, robot_m, rng, draw)
        self.memory = Memory(self.memory.skin)  # the paper takes poses for exact
        self._is_searched = True  # and its belief for the whole truth

    def take(self, scan: ScanEvidence) -> tuple[int, float]:
        """The number of samples falls with each contact to nothing: the paper's algorithm sets no
        lower limit, so a belief that settled wrongly stays wrong."""
        share = INJECTED_DECAY ** max(scan.number - 1, 0)
        wanted = min(round(share * self._config.injected), len(self.belief))
        samples = self._draw(scan.observation, wanted)
        inject(self.belief, samples)
        exact = replace(scan, observation=replace(scan.observation, place_sd_m=0.0))
        self.belief.remembered = self.memory.plus(exact).explain(self.belief.pose)
        evidence = pf.reweight(self.belief, self.belief.remembered[:, 0])
        if evidence is None:
            self.belief, evidence = pf.uniform(self._config, self._rng), 0.0
            if len(samples):
                new = pf.equal(samples, np.empty((len(samples), 0)))
                self.belief = pf.resample(new, len(self.belief), self._rng)
        elif pf.resampling_is_due(self.belief):
            self.belief = pf.resample(self.belief, len(self.belief), self._rng)
            self.belief.pose = pf.roughened(self.belief.pose, self._rng, self.metric.scale)
        self._place = None
        return len(samples), evidence

    def tell(self, pose: PosePrior, contacts: int) -> None:
        """The paper knows no prior."""


def inject(belief: Belief, poses: Poses) -> None:
    """The lightest particles give way to samples (S, 3) of mean weight; then the weights are
    normalised."""
    n, count = len(belief), min(len(poses), len(belief))
    if not count:
        return
    lowest = np.argpartition(belief.log_weight, count - 1)[:count]
    belief.pose[lowest] = poses[:count]
    belief.log_weight[lowest] = -np.log(n)  # weights sum to 1: their mean is 1 / N
    pf.normalise(belief)
