"""Algorithm 1 of Marić et al. 2025, kept as the baseline."""

from dataclasses import replace

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.memory import Memory
from taxeld.estimator.object_belief import Confidence, Draw, ObjectBelief
from taxeld.estimator.particles import Particles
from taxeld.estimator.scans import ScanEvidence
from taxeld.model.observation import ObservationModel
from taxeld.prior import PosePrior

INJECTED_DECAY = 0.5  # samples of a contact, of those of the contact before


class Paper(ObjectBelief):
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
        self._confidence = Confidence.SEARCHED  # and its belief for the whole truth
        self._take_place(self._placed())

    def take(self, scan: ScanEvidence) -> tuple[int, float]:
        """The number of samples falls with each contact to nothing: the paper's algorithm sets no
        lower limit, so a belief that settled wrongly stays wrong."""
        share, particles = INJECTED_DECAY ** max(scan.number - 1, 0), self.particles
        wanted = min(round(share * self._config.injected), len(particles))
        samples = self._draw(scan.observation, wanted)
        inject(particles, samples)
        exact = replace(scan, observation=replace(scan.observation, place_sd_m=0.0))
        particles.explained = self.memory.plus(exact).explain(particles.pose)
        evidence = pf.reweight(particles, particles.explained.scans[:, 0])
        if evidence is None:
            self.particles, evidence = pf.uniform(self._config, self._rng), 0.0
            if len(samples):
                self.particles = pf.resample(pf.equal(samples), len(particles), self._rng)
        elif pf.resampling_is_due(particles):
            self.particles = pf.resample(particles, len(particles), self._rng)
            self.particles.pose = pf.roughened(self.particles.pose, self._rng, self.metric.scale)
        self._take_place(self._placed())
        return len(samples), evidence

    def take_prior(self, pose: PosePrior, contacts: int) -> None:
        """The paper knows no prior."""


def inject(particles: Particles, poses: Poses) -> None:
    """The lightest particles give way to samples (S, 3) of mean weight; then the weights are
    normalised."""
    n, count = len(particles), min(len(poses), len(particles))
    if not count:
        return
    lowest = np.argpartition(particles.log_weight, count - 1)[:count]
    particles.pose[lowest] = poses[:count]
    particles.log_weight[lowest] = -np.log(n)  # weights sum to 1: their mean is 1 / N
    pf.normalise(particles)
