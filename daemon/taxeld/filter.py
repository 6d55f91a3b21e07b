"""The particle filter: a belief over object poses in the world, and the steps that change it.

Particles are a structure of arrays with log-weights; each step is a function of its own. Injection
is Algorithm 1 of Marić et al. 2025: the lowest-weight particles give way to samples of the inverse
observation model at the mean weight.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld import se2
from taxeld.se2 import Poses

Floats = NDArray[np.float64]

RESAMPLE_BELOW = 0.5  # of N: effective sample size at which particles are drawn anew
ROUGHENING_M = 0.001  # sd of the jitter of drawn particles, so that copies part
ROUGHENING_RAD = 0.01


@dataclass(slots=True)
class Belief:
    """N weighted poses; log-weights are normalised (their exponentials sum to 1)."""

    pose: Poses  # (N, 3) world frame
    log_weight: Floats  # (N,)

    def __len__(self) -> int:
        return len(self.log_weight)

    @property
    def weight(self) -> Floats:
        return np.exp(self.log_weight)


def uniform(
    n: int, centre_m: tuple[float, float], half_width_m: float, rng: np.random.Generator
) -> Belief:
    """N equally weighted poses, uniform over a square and all turns."""
    low = np.array([centre_m[0] - half_width_m, centre_m[1] - half_width_m, -np.pi])
    high = np.array([centre_m[0] + half_width_m, centre_m[1] + half_width_m, np.pi])
    return Belief(rng.uniform(low, high, (n, 3)), np.full(n, -np.log(n)))


def effective_sample_size(belief: Belief) -> float:
    """1 / Σ w²: N for equal weights, 1 for a single survivor."""
    return float(1.0 / np.sum(np.exp(2.0 * belief.log_weight)))


def reweight(belief: Belief, log_likelihood: Floats) -> float | None:
    """Multiply the weights by a likelihood (N,); → log evidence log Σ w p(z | q).

    None, with the belief unchanged, where every pose is impossible or a value is not a number.
    """
    log_weight = belief.log_weight + log_likelihood
    top = log_weight.max()
    if not np.isfinite(top):
        return None
    log_sum = float(top + np.log(np.exp(log_weight - top).sum()))
    belief.log_weight = log_weight - log_sum
    return log_sum


def inject(belief: Belief, poses: Poses) -> None:
    """Replace the lowest-weight particles by `poses` (S, 3) at the mean weight; normalise."""
    count = min(len(poses), len(belief))
    if not count:
        return
    lowest = np.argpartition(belief.log_weight, count - 1)[:count]
    belief.pose[lowest] = poses[:count]
    belief.log_weight[lowest] = -np.log(len(belief))  # weights sum to 1, so this is their mean
    top = belief.log_weight.max()
    belief.log_weight -= top + np.log(np.exp(belief.log_weight - top).sum())


def resampling_is_due(belief: Belief) -> bool:
    return effective_sample_size(belief) < RESAMPLE_BELOW * len(belief)


def resample(belief: Belief, rng: np.random.Generator) -> None:
    """Systematic resampling with roughening; weights become equal."""
    n = len(belief)
    cumulative = np.cumsum(belief.weight)
    cumulative[-1] = 1.0  # rounding must not leave the last draw without a particle
    drawn = np.searchsorted(cumulative, (rng.random() + np.arange(n)) / n)
    jitter = rng.standard_normal((n, 3)) * (ROUGHENING_M, ROUGHENING_M, ROUGHENING_RAD)
    first = np.concatenate([[True], drawn[1:] != drawn[:-1]])
    jitter[first] = 0.0  # one copy of each stays where it was
    pose = belief.pose[drawn] + jitter
    pose[:, 2] = se2.wrap(pose[:, 2])
    belief.pose = pose
    belief.log_weight = np.full(n, -np.log(n))
