"""The interface of a rule: how a belief learns from scans, and from samples of contacts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.evidence import ObjectEvidence
from taxeld.estimator.particles import Belief
from taxeld.estimator.verdict import Place
from taxeld.model.noise import Noise
from taxeld.model.observation import Lesson, Observation
from taxeld.model.response import SAG_M, SAG_SD
from taxeld.model.symmetry import PoseMetric

Draw = Callable[[Observation, int], Poses]
"""Poses (≤ n, 3) in the world that explain an observation by itself."""

PUSHED_M = 2e-4  # m between two scans: a shorter way is a press that settles


@dataclass(slots=True)
class EstimatorCounters:
    """Counters of scans and their use, since start."""

    scans: int = 0
    updates: int = 0  # scans that were learned from
    thoughts: int = 0  # second opinions that changed the belief
    jumps: int = 0  # scans whose sensor pose is too far from the last, not used
    stuck: int = 0  # scans in which a taxel read the same as ever, and was left out


class Rule(Protocol):
    """A belief, how it learns, and how reliable it is."""

    belief: Belief
    metric: PoseMetric
    weighed: ObjectEvidence
    share: float  # probability of its object among those that it may be

    @property
    def place(self) -> Place:
        """Where the belief has its object."""
        ...

    @property
    def is_open(self) -> bool:
        """Whether `revisit` may find anything."""
        ...

    def follow(self, before: Observation, after: Observation) -> None:
        """Move the belief with an object that is pushed from one scan to the next."""
        ...

    def learn(self, observation: Observation, contacts: int, draw: Draw) -> tuple[int, float]:
        """Take a scan of contact number `contacts`, or a silent one after it; → the number of
        samples injected, and the scan's log evidence."""
        ...

    def expected(self, after: int, link: int, /) -> Lesson | None:
        """The remembered contacts of a link after number `after`, and the depths that the belief
        expects of them; None where nothing is remembered."""
        ...

    def revisit(self, draw: Draw) -> int:
        """While there is nothing to learn, take a second opinion: look for poses that explain all
        contacts better; → the number of samples used."""
        ...


def drawn(draw: Draw, observation: Observation, n: int) -> Poses:
    """Samples (≤ n, 3) of a contact; none of a silent scan."""
    return draw(observation, n) if n and observation.is_contact else np.empty((0, 3))


def noise_of(config: FilterConfig) -> Noise:
    """Errors of a skin of which no more is known than its kind."""
    return Noise(config.noise_sigma, config.gain_cv, sag_m=SAG_M, sag_sd=SAG_SD)


def anew(config: FilterConfig, rng: np.random.Generator) -> Belief:
    """A uniform belief without memory."""
    return pf.uniform(config.particles, config.centre_m, config.half_width_m, rng)
