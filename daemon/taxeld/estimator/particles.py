"""The particle filter: weighted poses of an object in the world, and the steps that change them.

Particles are a structure of arrays with log-weights; each step is a function of its own.

A sample of p(q | contact) takes no other scan into account. The paper still gives it the mean
weight, so right particles can lose to samples that explain only the present contact (`paper`). Here
samples are importance samples: they are weighed by all that is remembered, and then merged with the
particles by their evidence.
"""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.model import se2

RESAMPLE_BELOW = 0.5  # share of N: particles are resampled below this effective sample size
MOVE = np.array([0.002, 0.002, 0.02])  # m, m, rad: sd of a random step, times 2^u
MOVE_OCTAVES = (-2.5, 1.5)  # range of u: coarse steps separate the copies, fine ones settle them
# factors on the difference of two other particles, for half of the steps
DIFFERENCES = np.array([0.3, 0.7, 1.0])
KLD_ERROR = 0.05  # nats between a wide density and its particles
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


class Explained(NamedTuple):
    """Log-densities by which N poses explain what is remembered."""

    scans: Floats  # (N, K) log p(scan | pose) over the live taxels
    priors: Floats  # (N, P)


Explain = Callable[[Poses], Explained]
"""How well poses (N, 3) explain what is remembered."""

Support = Callable[[Explained], Floats]
"""The log-density (N,) of poses by what they explain."""


@dataclass(slots=True)
class Particles:
    """N weighted poses; log-weights are normalised (their exponentials sum to 1)."""

    pose: Poses  # (N, 3) world frame
    log_weight: Floats  # (N,)
    explained: Explained
    ground: Floats  # (N, K) assumptions on sliding; K = 0 without motion

    def __len__(self) -> int:
        return len(self.log_weight)

    @property
    def weight(self) -> Floats:
        """(N,) weights of sum 1."""
        return np.exp(self.log_weight)


def uniform(config: FilterConfig, rng: np.random.Generator) -> Particles:
    """Particles that know nothing: poses over `filter`'s square and all turns, without memory."""
    (x, y), half_m = config.centre_m, config.half_width_m
    low, high = [x - half_m, y - half_m, -np.pi], [x + half_m, y + half_m, np.pi]
    return equal(rng.uniform(low, high, (config.particles, 3)))


def equal(
    pose: Poses, explained: Explained | None = None, ground: Floats | None = None
) -> Particles:
    """Equally weighted poses (N, 3) and what they explain; `ground` (N, K)."""
    n, none = len(pose), np.empty((len(pose), 0))
    explained = explained or Explained(none, none)
    return Particles(pose, np.full(n, -np.log(n)), explained, none if ground is None else ground)


def effective_sample_size(particles: Particles) -> float:
    """1 / Σ w²: N for equal weights, 1 for a single survivor."""
    return float(1.0 / np.sum(np.exp(2.0 * particles.log_weight)))


def normalise(particles: Particles) -> float:
    """Make the weights sum to 1; → the logarithm of their sum before."""
    log_sum = log_sum_exp(particles.log_weight)
    particles.log_weight = particles.log_weight - log_sum
    return log_sum


def reweight(particles: Particles, log_likelihood: Floats) -> float | None:
    """Multiply the weights by a likelihood (N,); → log evidence log Σ w p(z | q).

    None, with the particles unchanged, where every pose is impossible or a value is not a number.
    """
    log_weight = particles.log_weight + log_likelihood
    if not np.isfinite(log_weight.max()):
        return None
    particles.log_weight = log_weight
    return normalise(particles)


def resampling_is_due(particles: Particles) -> bool:
    """Whether the effective sample size is below RESAMPLE_BELOW."""
    return effective_sample_size(particles) < RESAMPLE_BELOW * len(particles)


def resample(particles: Particles, n: int, rng: np.random.Generator) -> Particles:
    """Systematic resampling: `n` particles of equal weight."""
    cumulative = np.cumsum(particles.weight)
    cumulative[-1] = 1.0  # rounding must not leave the last draw without a particle
    below = np.ceil(n * cumulative - rng.random()).astype(np.intp)  # teeth of a comb of n
    below[1:] -= below[:-1].copy()
    drawn = np.repeat(np.arange(len(particles)), below)
    explained = Explained(*(each.take(drawn, axis=0) for each in particles.explained))
    return equal(
        particles.pose.take(drawn, axis=0), explained, particles.ground.take(drawn, axis=0)
    )


def roughened(poses: Poses, rng: np.random.Generator, scale: float) -> Poses:
    """Poses (N, 3), separated by random steps."""
    poses = poses + _random_steps(len(poses), rng, scale)
    poses[:, 2] = se2.wrap(poses[:, 2])
    return poses


def rejuvenate(
    particles: Particles,
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
    n = len(particles)
    step = _random_steps(n, rng, scale)
    one, other = rng.integers(n, size=(2, n))
    apart = particles.pose.take(one, axis=0)
    apart -= particles.pose.take(other, axis=0)
    apart[:, 2] = se2.wrap(apart[:, 2])
    apart *= DIFFERENCES.take(rng.integers(len(DIFFERENCES), size=(n, 1)))
    along = rng.random((n, 1)) >= 0.5
    apart += 0.1 * step
    poses = particles.pose + np.where(along, apart, step)
    poses[:, 2] = se2.wrap(poses[:, 2])
    before, least = particles.explained, np.log(rng.random(n))
    explained = explain(poses)
    now = support(_both(explained, before))
    taken = least < now[:n] - now[n:]
    if room is not None:
        taken &= room.lets(particles.pose, poses)
    particles.pose[taken] = poses[taken]
    for each, new in zip(before, explained, strict=True):
        each[taken] = new[taken]


def _both(one: Explained, other: Explained) -> Explained:
    return Explained(*map(np.concatenate, zip(one, other, strict=True)))


def _random_steps(n: int, rng: np.random.Generator, scale: float) -> Poses:
    low, high = MOVE_OCTAVES
    size = np.exp2(low + (high - low) * rng.random((n, 1)))
    move = MOVE * [min(scale, 1.0), min(scale, 1.0), 1.0 / max(scale, 1.0)]
    steps = rng.standard_normal((n, 3))
    steps *= move
    steps *= size
    return steps


def merge(a: Particles, evidence_a: float, b: Particles, evidence_b: float) -> Particles:
    """Both in one, each weighed by its log evidence."""
    made = Particles(
        np.concatenate([a.pose, b.pose]),
        np.concatenate([a.log_weight + evidence_a, b.log_weight + evidence_b]),
        _both(a.explained, b.explained),
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
    """The particles that a density over `cells` cells needs for a Kullback–Leibler divergence from
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
