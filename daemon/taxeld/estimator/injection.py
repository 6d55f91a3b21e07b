"""How samples of a contact enter the belief: by the paper's rule, or weighed against it.

A sample of p(q | contact) takes no other scan into account. The paper gives it the mean weight all
the same, and a belief that is right can lose to samples that explain the present contact alone.
Here the samples are first *annealed* into a second opinion of the whole posterior, which stands
beside the belief by its evidence.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats, Poses
from taxeld.estimator import particles as pf
from taxeld.estimator.particles import Belief, Explain
from taxeld.model import contacts
from taxeld.model.observation import ObservationModel

KEPT = 0.25  # of the samples: effective number that a stage of annealing leaves
STAGES_MAX = 6  # the last takes all that is left
MODE = np.array([0.02, 0.02, 0.3])  # cells of poses, each taken for a Gaussian
TYPICAL_NATS = 8.0  # by which a particle lies below its cell's best; one farther down is astray
NARROWEST = np.array([1e-4, 1e-4, 1e-3])  # sd of a cell's particles: m, m, rad
FREEDOM = 4.0  # particles' worth of what all cells together tell of a cell's spread
LEAST_COUNT = 1e-12


def paper(belief: Belief, poses: Poses) -> None:
    """Algorithm 1 of Marić et al. 2025: the least particles give way to samples (S, 3), at the mean
    weight; then the weights are normalised."""
    n, count = len(belief), min(len(poses), len(belief))
    if not count:
        return
    lowest = np.argpartition(belief.log_weight, count - 1)[:count]
    belief.pose[lowest] = poses[:count]
    belief.log_weight[lowest] = -np.log(n)  # weights sum to 1: their mean is 1 / N
    pf.normalise(belief)


def anneal(
    samples: Belief,
    own: Floats,
    share: Floats,
    explain: Explain,
    rng: np.random.Generator,
    scale: float = 1.0,
) -> Belief:
    """Equally weighted samples of ∏ p(z_k | q)^own_k brought to ∏ p(z_k | q)^share_k: the other
    scans count by degrees, and after each step the samples are drawn anew and moved (an SMC
    sampler, Del Moral et al. 2006). A step is as large as leaves the share KEPT of them.

    own (terms,) in 0..1: the terms that the samples have taken into account; `scale`: of the
    object's size, to the usual.
    """
    n, rest = len(samples), share - own
    degree = 0.0
    for stage in range(STAGES_MAX):
        gain = samples.remembered @ rest
        left = 1.0 - degree
        step = left if stage == STAGES_MAX - 1 else _step(gain, left, KEPT * n)
        samples.log_weight = step * gain
        pf.normalise(samples)
        samples = pf.resample(samples, n, rng)
        degree += step
        pf.rejuvenate(samples, explain, own + degree * rest, rng, scale)
        if step == left:
            break
    return samples


def merge(a: Belief, b: Belief, share: Floats, scale: float = 1.0) -> Belief:
    """Two samplings of one posterior as one: where both found a mode it is not doubled, and the
    larger sampling does not outweigh the other.

    Each cell of poses weighs what a Gaussian of its particles integrates to, whichever sampling
    they are of: ∫ p ≈ exp(E log p) |2πe Σ|^½, as for any Gaussian.
    """
    pose = np.concatenate([a.pose, b.pose])
    remembered = np.concatenate([a.remembered, b.remembered])
    count = np.concatenate([c.weight * pf.effective_sample_size(c) for c in (a, b)])
    support = remembered @ share
    _, cell = np.unique(np.floor(pose / (MODE * [scale, scale, 1.0])), axis=0, return_inverse=True)
    top = np.full(int(cell.max()) + 1, -np.inf)
    np.maximum.at(top, cell, support)
    count = count * np.exp(-np.maximum(top.take(cell) - support - TYPICAL_NATS, 0.0))
    total = np.maximum(np.bincount(cell, count), LEAST_COUNT)
    mass = np.bincount(cell, count * support) / total + 0.5 * _log_room(pose, cell, count, total)
    made = Belief(
        pose, np.log(np.maximum(count, LEAST_COUNT)) + (mass - np.log(total)).take(cell), remembered
    )
    pf.normalise(made)
    return made


def _log_room(pose: Poses, cell: NDArray[np.intp], count: Floats, total: Floats) -> Floats:
    """log |Σ| of the particles of each cell. Few tell little of their spread: all cells together
    tell the rest."""
    at = [np.bincount(cell, count * column) / total for column in pose.T]
    off = pose - np.stack(at, axis=1).take(cell, axis=0)
    pairs = [(i, j) for i in range(3) for j in range(3)]
    each = np.stack([np.bincount(cell, count * off[:, i] * off[:, j]) for i, j in pairs], axis=1)
    usual = each.sum(axis=0) / total.sum() + np.diag(NARROWEST**2).ravel()
    cov = (each + FREEDOM * usual) / (total + FREEDOM)[:, None]
    return np.asarray(np.linalg.slogdet(cov.reshape(-1, 3, 3))[1])


def project(model: ObservationModel, poses: Poses) -> Poses:
    """Samples (S, 3) in the sensor frame brought onto the contact manifold by one step (Marić et
    al. 2026): those that miss the object, or press deeper than a taxel can tell, are moved along
    the contact's normal; the others keep the depth, and thus the spread, that they have."""
    ax, ay = contacts.axis_in_object(poses)
    radius_m = model.layout.radius_m
    depth = radius_m - model.scene.clearance(ax, ay)[0]
    return contacts.project(model.scene, radius_m, poses, np.clip(depth, 0.0, model.depth_max_m))[0]


def _step(gain: Floats, most: float, kept: float) -> float:
    """The largest power of exp(gain), up to `most`, that leaves `kept` effective samples."""
    gain = gain - gain.max()

    def left(power: float) -> float:
        weight = np.exp(power * gain)
        return float(weight.sum() ** 2 / (weight @ weight))

    if left(most) >= kept:
        return most
    low, high = 0.0, most
    for _ in range(12):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if left(middle) >= kept else (low, middle)
    return high
