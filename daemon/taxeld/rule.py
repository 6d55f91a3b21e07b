"""What a rule is by which a belief learns from scans and the samples of touches."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from taxeld import filter as pf
from taxeld.config import FilterConfig
from taxeld.filter import Belief
from taxeld.memory import Felt
from taxeld.observation import Noise
from taxeld.se2 import Poses

PUSHED_M = 2e-4  # between two scans: less than this is a press that settles


@dataclass(slots=True)
class RuleCounters:
    """Since start."""

    impossible: int = 0  # scans under which every pose was impossible: the belief began anew
    inconsistent: int = 0  # scans that no pose explained
    forgotten: int = 0  # times that the past was dropped: the object had moved


class Rule(Protocol):
    """A belief, and how it learns."""

    belief: Belief
    doubt: bool  # whether no pose explains the newest scan, or all together
    counters: RuleCounters

    @property
    def sure(self) -> bool:
        """Whether enough scans and samples agree for a narrow belief to be trusted."""
        ...

    def follow(self, before: Felt, after: Felt) -> bool:
        """Move the belief as the object does that is pushed from one scan to the next; → whether
        it was."""
        ...

    def wanted(self, settled: float) -> int:
        """How many samples the next touch should bring, given the heaviest mode's weight."""
        ...

    def learn(self, felt: Felt, samples: Poses) -> float:
        """Take a scan, and poses (S, 3) in the world that explain it by themselves (none for a
        silent one); → log evidence."""
        ...

    def recalled(self) -> Felt | None:
        """A touch whose samples may better the belief while nothing new is felt; None: no need."""
        ...

    def think(self, samples: Poses) -> None:
        """Take poses (S, 3) in the world that explain the touch that was recalled."""
        ...

    def searched(self, samples: int, *, agreed: bool) -> None:
        """Hear whether so many samples have left a narrow belief where it was."""
        ...


def noise_of(config: FilterConfig) -> Noise:
    return Noise(config.noise_sigma, config.gain_cv, config.outliers)


def anew(config: FilterConfig, rng: np.random.Generator) -> Belief:
    """A uniform belief that remembers nothing."""
    return pf.uniform(config.particles, config.centre_m, config.half_width_m, rng)
