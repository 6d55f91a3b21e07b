"""The particle filter: a belief over object poses in the world, and the steps that change it.

Particles are a structure of arrays with log-weights; each step is a function of its own.

A sample of p(q | contact) takes no other scan into account. The paper still gives it the mean
weight, so a right belief can lose to samples that explain only the present contact (`paper`). Here
the samples are first weighed by all that is remembered. They are then a belief of their own, an
opinion, which is merged with the belief by its evidence.
"""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.model import se2

Explain = Callable[[Poses], Floats]
"""How well poses (N, 3) explain the remembered scans: (N, terms) as in `Belief.remembered`."""

Support = Callable[[Floats], Floats]
"""The log-density of poses by what they explain: (N, terms) → (N,)."""

RESAMPLE_BELOW = 0.5  # share of N: particles are resampled below this effective sample size
MOVE = np.array([0.002, 0.002, 0.02])  # m, m, rad: sd of a random step, times 2^u
MOVE_OCTAVES = (-2.5, 1.5)  # range of u: coarse steps separate the copies, fine ones settle them
# factors on the difference of two other particles, for half of the steps
DIFFERENCES = np.array([0.3, 0.7, 1.0])
KLD_ERROR = 0.05  # nats between a wide belief and its particles
CELL = np.array([0.01, 0.01, np.radians(10.0)])  # m, m, rad: cells of SE(2)


class Room(NamedTuple):
    """A circle that steps do not leave."""

    centre: Floats  # (2,) [m]
    radius_m: float

    def lets(self, before: Poses, after: Poses) -> Bools:
        """(N,) whether steps from `before` (N, 3) to `after` (N, 3) stay within, or lead back."""
        gap = self._gap(after)
        within = gap <= self.radius_m
        return within if within.all() else within | (gap < self._gap(before))

    def _gap(self, poses: Poses) -> Floats:
        x, y = poses[:, 0] - self.centre[0], poses[:, 1] - self.centre[1]
        return np.asarray(np.sqrt(x * x + y * y))


@dataclass(slots=True)
class Belief:
    """N weighted poses; log-weights are normalised (their exponentials sum to 1)."""

    pose: Poses  # (N, 3) world frame
    log_weight: Floats  # (N,)
    remembered: Floats  # (N, terms) as `Memory.explain` has them
    ground: Floats  # (N, K) assumptions on sliding; K = 0 without motion

    def __len__(self) -> int:
        return len(self.log_weight)

    @property
    def weight(self) -> Floats:
        """(N,) weights of sum 1."""
        return np.exp(self.log_weight)


def uniform(config: FilterConfig, rng: np.random.Generator) -> Belief:
    """A belief that knows nothing: poses over `filter`'s square and all turns, without memory."""
    (x, y), half_m = config.centre_m, config.half_width_m
    low, high = [x - half_m, y - half_m, -np.pi], [x + half_m, y + half_m, np.pi]
    poses = rng.uniform(low, high, (config.particles, 3))
    return equal(poses, np.empty((config.particles, 0)))


def equal(pose: Poses, remembered: Floats, ground: Floats | None = None) -> Belief:
    """Equally weighted poses (N, 3) with log-likelihoods `remembered` (N, terms) and `ground` (N,
    K)."""
    n = len(pose)
    ground = np.empty((n, 0)) if ground is None else ground
    return Belief(pose, np.full(n, -np.log(n)), remembered, ground)


def effective_sample_size(belief: Belief) -> float:
    """1 / Σ w²: N for equal weights, 1 for a single survivor."""
    return float(1.0 / np.sum(np.exp(2.0 * belief.log_weight)))


def normalise(belief: Belief) -> float:
    """Make the weights sum to 1; → the logarithm of their sum before."""
    log_sum = log_sum_exp(belief.log_weight)
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


def resampling_is_due(belief: Belief) -> bool:
    """Whether the effective sample size is below RESAMPLE_BELOW."""
    return effective_sample_size(belief) < RESAMPLE_BELOW * len(belief)


def resample(belief: Belief, n: int, rng: np.random.Generator) -> Belief:
    """Systematic resampling: `n` particles of equal weight."""
    cumulative = np.cumsum(belief.weight)
    cumulative[-1] = 1.0  # rounding must not leave the last draw without a particle
    below = np.ceil(n * cumulative - rng.random()).astype(np.intp)  # teeth of a comb of n
    below[1:] -= below[:-1].copy()
    drawn = np.repeat(np.arange(len(belief)), below)
    of_each = (belief.pose, belief.remembered, belief.ground)
    return equal(*(each.take(drawn, axis=0) for each in of_each))


def roughened(poses: Poses, rng: np.random.Generator, scale: float) -> Poses:
    """Poses (N, 3), separated by random steps."""
    poses = poses + _random_steps(len(poses), rng, scale)
    poses[:, 2] = se2.wrap(poses[:, 2])
    return poses


def rejuvenate(
    belief: Belief,
    explain: Explain,
    support: Support,
    rng: np.random.Generator,
    scale: float = 1.0,
    room: Room | None = None,
) -> None:
    """One Metropolis step of every particle; it leaves the posterior, of log-density `support`,
    unchanged (resample-move, Gilks & Berzuini 2001).

    Half of the steps are random, half along the difference of two other particles, which follows
    the posterior's own shape (differential evolution, ter Braak 2006). `scale`: the object's size
    over the usual. Where nothing was touched all poses explain the same, and only `room` keeps
    particles from straying.
    """
    n = len(belief)
    step = _random_steps(n, rng, scale)
    one, other = rng.integers(n, size=(2, n))
    apart = belief.pose.take(one, axis=0)
    apart -= belief.pose.take(other, axis=0)
    apart[:, 2] = se2.wrap(apart[:, 2])
    apart *= DIFFERENCES.take(rng.integers(len(DIFFERENCES), size=(n, 1)))
    along = rng.random((n, 1)) >= 0.5
    apart += 0.1 * step
    poses = belief.pose + np.where(along, apart, step)
    poses[:, 2] = se2.wrap(poses[:, 2])
    before, least = belief.remembered, np.log(rng.random(n))
    remembered = explain(poses)
    now = support(np.concatenate([remembered, before]))
    taken = least < now[:n] - now[n:]
    if room is not None:
        taken &= room.lets(belief.pose, poses)
    belief.pose[taken] = poses[taken]
    belief.remembered[taken] = remembered[taken]


def _random_steps(n: int, rng: np.random.Generator, scale: float) -> Poses:
    low, high = MOVE_OCTAVES
    size = np.exp2(low + (high - low) * rng.random((n, 1)))
    move = MOVE * [min(scale, 1.0), min(scale, 1.0), 1.0 / max(scale, 1.0)]
    steps = rng.standard_normal((n, 3))
    steps *= move
    steps *= size
    return steps


def merge(a: Belief, evidence_a: float, b: Belief, evidence_b: float) -> Belief:
    """Both beliefs in one, each weighed by its log evidence."""
    made = Belief(
        np.concatenate([a.pose, b.pose]),
        np.concatenate([a.log_weight + evidence_a, b.log_weight + evidence_b]),
        np.concatenate([a.remembered, b.remembered]),
        np.concatenate([a.ground, b.ground]),
    )
    normalise(made)
    return made


def occupied(poses: Poses, cell: Floats = CELL) -> int:
    """The number of cells of SE(2) that hold one of the poses (N, 3); `cell` (3,) is in m, m,
    rad."""
    at = np.floor(poses / cell).astype(np.int64)
    at -= at.min(axis=0)
    size = at.max(axis=0) + 1
    cells = np.sort((at[:, 0] * size[1] + at[:, 1]) * size[2] + at[:, 2])
    return 1 + int(np.count_nonzero(np.diff(cells)))


def enough(cells: int) -> int:
    """The particles that a belief over `cells` cells needs for a Kullback–Leibler divergence from
    its own histogram of at most `KLD_ERROR`, with probability 0.99 (KLD-sampling, Fox 2003, eq.
    7)."""
    if cells < 2:
        return 1
    k = cells - 1
    root = 1.0 - 2.0 / (9.0 * k) + np.sqrt(2.0 / (9.0 * k)) * NormalDist().inv_cdf(0.99)
    return int(np.ceil(k / (2.0 * KLD_ERROR) * root**3))


def log_sum_exp(values: Floats) -> float:
    """log Σ exp(values)."""
    top = values.max()
    return float(top + np.log(np.exp(values - top).sum()))
