"""The particle filter: a belief over object poses in the world, and the steps that change it.

Particles are a structure of arrays with log-weights; each step is a function of its own. Injection
is Algorithm 1 of Marić et al. 2025: the lowest-weight particles give way to samples of the inverse
observation model at the mean weight. Two things are added, both from the memory of past touches: a
sample's weight is the mean weight times how well it explains them, and particles that resampling
copied part by Metropolis steps towards all touches at once.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld import se2
from taxeld.se2 import Poses

Floats = NDArray[np.float64]

RESAMPLE_BELOW = 0.5  # of N: effective sample size at which particles are drawn anew
MOVE_M, MOVE_RAD = 0.002, 0.02  # sd of a Metropolis step, times 2^u with u in MOVE_OCTAVES
MOVE_OCTAVES = (-2.5, 1.5)  # coarse steps part the copies, fine ones settle them


@dataclass(slots=True)
class Belief:
    """N weighted poses; log-weights are normalised (their exponentials sum to 1)."""

    pose: Poses  # (N, 3) world frame
    log_weight: Floats  # (N,)
    remembered: Floats  # (N, K) log-likelihood of each of K remembered touches

    def __len__(self) -> int:
        return len(self.log_weight)

    @property
    def weight(self) -> Floats:
        return np.exp(self.log_weight)

    @property
    def support(self) -> Floats:
        """(N,) how well each pose explains all remembered touches."""
        return np.asarray(self.remembered.sum(axis=1))


def uniform(
    n: int, centre_m: tuple[float, float], half_width_m: float, rng: np.random.Generator
) -> Belief:
    """N equally weighted poses, uniform over a square and all turns, that remember nothing."""
    low = np.array([centre_m[0] - half_width_m, centre_m[1] - half_width_m, -np.pi])
    high = np.array([centre_m[0] + half_width_m, centre_m[1] + half_width_m, np.pi])
    return Belief(rng.uniform(low, high, (n, 3)), np.full(n, -np.log(n)), np.empty((n, 0)))


def effective_sample_size(belief: Belief) -> float:
    """1 / Σ w²: N for equal weights, 1 for a single survivor."""
    return float(1.0 / np.sum(np.exp(2.0 * belief.log_weight)))


def normalise(belief: Belief) -> float:
    """Make the weights sum to 1; → the logarithm of what they summed to."""
    log_sum = _log_sum_exp(belief.log_weight)
    belief.log_weight = belief.log_weight - log_sum
    return log_sum


def reweight(belief: Belief, log_likelihood: Floats) -> float | None:
    """Multiply the weights by a likelihood (N,); → log evidence log Σ w p(z | q).

    None, with the belief unchanged, where every pose is impossible or a value is not a number.
    """
    log_weight = belief.log_weight + log_likelihood
    if not np.isfinite(log_weight.max()):
        return None
    belief.log_weight = log_weight
    return normalise(belief)


def inject(belief: Belief, poses: Poses, remembered: Floats) -> None:
    """Replace the lowest-weight particles by `poses` (S, 3), which explain the remembered touches
    by `remembered` (S, K); normalise.

    Each takes the mean weight times its support over the belief's own, at most N times the mean:
    one good sample may outweigh a bad belief. With no memory (K = 0) this is Algorithm 1.
    """
    n, count = len(belief), min(len(poses), len(belief))
    if not count:
        return
    typical = _log_sum_exp(belief.log_weight + belief.support)
    ratio = np.minimum(remembered[:count].sum(axis=1) - typical, np.log(n))
    lowest = np.argpartition(belief.log_weight, count - 1)[:count]
    belief.pose[lowest] = poses[:count]
    belief.remembered[lowest] = remembered[:count]
    belief.log_weight[lowest] = ratio - np.log(n)  # weights sum to 1: their mean is 1 / N
    normalise(belief)


def resampling_is_due(belief: Belief) -> bool:
    return effective_sample_size(belief) < RESAMPLE_BELOW * len(belief)


def resample(belief: Belief, rng: np.random.Generator) -> None:
    """Systematic resampling; weights become equal."""
    n = len(belief)
    cumulative = np.cumsum(belief.weight)
    cumulative[-1] = 1.0  # rounding must not leave the last draw without a particle
    drawn = np.searchsorted(cumulative, (rng.random() + np.arange(n)) / n)
    belief.pose = belief.pose[drawn]
    belief.remembered = belief.remembered[drawn]
    belief.log_weight = np.full(n, -np.log(n))


def rejuvenate(
    belief: Belief, explain: Callable[[Poses], Floats], rng: np.random.Generator
) -> None:
    """One Metropolis step of every particle towards the remembered touches, which leaves their
    posterior as it is (resample-move, Gilks & Berzuini 2001).

    `explain`: poses (N, 3) → (N, K), as in `Belief.remembered`. With no memory every step is taken:
    then this is plain roughening.
    """
    n = len(belief)
    size = np.exp2(rng.uniform(*MOVE_OCTAVES, (n, 1)))
    step = rng.standard_normal((n, 3)) * (MOVE_M, MOVE_M, MOVE_RAD)
    poses = belief.pose + size * step
    poses[:, 2] = se2.wrap(poses[:, 2])
    remembered = explain(poses)
    gain = remembered.sum(axis=1) - belief.support
    taken = np.log(rng.random(n)) < gain
    belief.pose[taken] = poses[taken]
    belief.remembered[taken] = remembered[taken]


def _log_sum_exp(values: Floats) -> float:
    top = values.max()
    return float(top + np.log(np.exp(values - top).sum()))
