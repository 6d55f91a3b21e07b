"""What a rule is: how a belief learns from scans, and from the samples that it asks for."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.confidence import Confidence
from taxeld.estimator.counters import RuleCounters
from taxeld.estimator.particles import Belief
from taxeld.estimator.parts import Parts
from taxeld.model.observation import Noise, Observation

__all__ = ["PUSHED_M", "Draw", "Parts", "Rule", "anew", "drawn", "noise_of"]

Draw = Callable[[Observation, int], Poses]
"""Poses (≤ n, 3) in the world that explain an observation by itself."""

PUSHED_M = 2e-4  # between two scans: less than this is a press that settles


class Rule(Protocol):
    """A belief, how it learns, and what it is worth."""

    belief: Belief
    confidence: Confidence
    counters: RuleCounters

    @property
    def slack(self) -> float:
        """How far scans are off, in units of what is configured."""
        ...

    def follow(self, before: Observation, after: Observation) -> None:
        """Move the belief as the object does that is pushed from one scan to the next."""
        ...

    def learn(
        self, observation: Observation, contacts: int, draw: Draw
    ) -> Parts[tuple[int, float]]:
        """Take a scan, of the last of so many contacts or a silent one; → how many samples it
        brought, and its log evidence."""
        ...

    def revisit(self, draw: Draw) -> Parts[int]:
        """While there is nothing to learn, look for poses that explain all contacts better; → how
        many samples that took."""
        ...


def drawn(draw: Draw, observation: Observation, n: int) -> Poses:
    """Samples (≤ n, 3) of a contact; silence has none."""
    return draw(observation, n) if n and observation.is_contact else np.empty((0, 3))


def noise_of(config: FilterConfig) -> Noise:
    return Noise(config.noise_sigma, config.gain_cv, config.outliers)


def anew(config: FilterConfig, rng: np.random.Generator) -> Belief:
    """A uniform belief that remembers nothing."""
    return pf.uniform(config.particles, config.centre_m, config.half_width_m, rng)
