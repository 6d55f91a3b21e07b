"""The exact posterior p(pose | taxels) by importance weights, and the distance of samples to it.

Simulated contacts under the sampler's own prior (the bank) are weighted by the likelihood of the
reading. No honest sampler beats this limit. On a layout with rotation symmetry each stored contact
is used in the turns that bring its strongest taxel to that of the reading, or beside it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats, Grid, Poses, Reals
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation
from taxeld_training.models.dataset import SimulatedTouches

BLOCK = 16_384  # presses weighed at once: they stay in the cache


@dataclass(frozen=True)
class Draws:
    """Samples (n, 3) of the posterior in the sensor frame, and its effective bank size."""

    pose: Poses
    ess: float


class ExactPosterior:
    """p(pose | z) over a bank of touches.

    A touch presses few taxels, so the bank keeps its pressed taxels alone. For all others the
    likelihood is that of a silent taxel, the same in every touch.
    """

    def __init__(self, bank: SimulatedTouches, layout: Layout, noise: Noise) -> None:
        self.noise = noise
        self.layout = layout
        self._pose = bank.pose
        self._sector = layout.sector[bank.activation.argmax(axis=1)]
        self._row, self._taxel = np.nonzero(bank.activation)
        self._h = bank.activation[self._row, self._taxel]
        order = len(layout.turns)
        self._back = layout.turns[-np.arange(order) % order].astype(np.intp)

    def sample(
        self, seen: Observation, n: int, rng: np.random.Generator, least: float = 0.0
    ) -> Draws:
        """`n` draws with replacement, by importance weight, for a reading. The weights are
        flattened until they have an effective number of `least`."""
        order = len(self.layout.turns)
        target = self.layout.sector[np.where(seen.live, seen.z, -1.0).argmax()]
        # noise moves the strongest taxel, but hardly ever farther than to a neighbour
        offsets = range(order) if order <= 3 else (-1, 0, 1)
        log_w, turn = [], []
        for offset in offsets:
            by = (self._sector - target - offset) % order
            log_w.append(self._log_weights(seen, by))
            turn.append(by)
        weights = flattened(np.concatenate(log_w), least)
        pick = rng.choice(len(weights), n, p=weights)
        angle = -2.0 * np.pi * np.concatenate(turn)[pick] / order
        zero = np.zeros(n)
        turned = np.stack([zero, zero, angle], axis=1)
        pose = se2.compose(turned, self._pose[pick % len(self._pose)])
        return Draws(pose, effective(weights))

    def _log_weights(self, seen: Observation, by: NDArray[np.int64]) -> Floats:
        """Log-likelihood (B,) of a reading for every stored contact, turned by −2π·by/order, by
        (B,)."""
        # turning a stored contact by −k is the same as turning the reading by +k
        at = self._taxel
        if len(self._back) > 1:
            at = self._back[by[self._row], at]
        silent, gain = gains(self.noise, seen, at, self._h)
        return np.asarray(silent + np.bincount(self._row, gain, len(by)))


def gains(noise: Noise, seen: Observation, at: NDArray[np.intp], h: Reals) -> tuple[float, Grid]:
    """The log-likelihood of a reading where nothing is pressed, and what it gains (P,) by presses
    of taxels `at` (P,) as deep as h (P,), in single precision."""
    floor = np.broadcast_to(seen.floor, len(seen.z))
    residue = np.broadcast_to(seen.residue, len(seen.z))
    unpressed = noise.log_density(seen.z, np.zeros(1), floor, residue)
    silent = np.where(seen.live, unpressed, 0.0)
    by_taxel = np.stack([seen.z, floor, residue, silent, seen.live]).astype(np.float32)
    gain = np.empty(len(at), np.float32)
    for first in range(0, len(at), BLOCK):
        block = slice(first, first + BLOCK)
        z, low, left, zero, live = by_taxel.take(at[block], axis=1)
        np.multiply(noise.log_density(z, h[block], low, left) - zero, live, out=gain[block])
    return float(silent.sum()), gain


def flattened(log_weight: Floats, least: float = 0.0) -> Floats:
    """(n,) weights that sum to 1, of the highest power, up to 1, that leaves `least` effective, for
    log weights (n,)."""
    log_weight = log_weight - log_weight.max()

    def at(power: float) -> Floats:
        weight = np.exp(power * log_weight)
        return np.asarray(weight / weight.sum())

    low, high = 0.0, 1.0
    if effective(at(high)) >= least:
        return at(high)
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(at(middle)) >= least else (low, middle)
    return at(low)


def effective(weight: Floats) -> float:
    """The effective number of weights (n,) that sum to 1."""
    return float(1.0 / (weight @ weight))


def energy_distance(a: Poses, b: Poses, length_m: float) -> float:
    """2 E|A−B| − E|A−A'| − E|B−B'| between the distributions behind pose sets (n, 3), a radian as
    far as `length_m`, in units of `length_m`. Zero only for equal ones (Székely & Rizzo).

    A U-statistic: no pose is compared with itself, so that it is right on average however few the
    poses are, and may be a little below zero.
    """
    pa, pb = embed(a, length_m), embed(b, length_m)
    within = sum(_mean_gap(own, own) * len(own) / (len(own) - 1) for own in (pa, pb))
    return float(2.0 * _mean_gap(pa, pb) - within)


def embed(poses: Poses, length_m: float) -> Floats:
    """Poses (n, 3) → (n, 4), whose Euclidean distance counts a radian as far as `length_m`."""
    x, y, theta = poses.T
    return np.column_stack([x / length_m, y / length_m, np.cos(theta), np.sin(theta)])


def _mean_gap(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.linalg.norm(a[:, None] - b[None], axis=-1).mean())
