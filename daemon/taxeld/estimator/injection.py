"""How samples of a contact enter the belief: by the paper's rule, or weighed against it.

A sample of p(q | contact) takes no other scan into account. The paper still gives it the mean
weight, so a right belief can lose to samples that explain only the present contact. Here the
samples are first *annealed* into a second opinion of the whole posterior, which is merged with the
belief by its evidence.
"""

from functools import partial

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator import particles as pf
from taxeld.estimator.particles import Belief, Explain, Support
from taxeld.model import contacts
from taxeld.model.observation import ObservationModel

KEPT = 0.25  # share of the samples that remains effective after a stage of annealing
STAGES_MAX = 6  # the last stage takes all that is left


def paper(belief: Belief, poses: Poses) -> None:
    """Algorithm 1 of Marić et al. 2025: the lightest particles give way to samples (S, 3) of mean
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
    own: Support,
    support: Support,
    explain: Explain,
    rng: np.random.Generator,
    scale: float = 1.0,
) -> Belief:
    """Bring equally weighted samples of log-density `own` to `support`. The difference is added by
    degrees, and after each step the samples are drawn anew and moved (an SMC sampler, Del Moral et
    al. 2006). A step is as large as leaves the share KEPT of them effective. `scale`: the object's
    size over the usual.
    """
    n, degree = len(samples), 0.0
    for stage in range(STAGES_MAX):
        gain = support(samples.remembered) - own(samples.remembered)
        left = 1.0 - degree
        step = left if stage == STAGES_MAX - 1 else _step(gain, left, KEPT * n)
        samples.log_weight = step * gain
        pf.normalise(samples)
        samples = pf.resample(samples, n, rng)
        degree += step
        now = partial(_between, own, support, degree)
        pf.rejuvenate(samples, explain, now, rng, scale)
        if step == left:
            break
    return samples


def _between(own: Support, support: Support, degree: float, explained: Floats) -> Floats:
    """(N,) log-density between two: explained is (N, terms)."""
    return np.asarray((1.0 - degree) * own(explained) + degree * support(explained))


def merge(a: Belief, evidence_a: float, b: Belief, evidence_b: float) -> Belief:
    """Both beliefs in one, each weighed by its log evidence."""
    made = Belief(
        np.concatenate([a.pose, b.pose]),
        np.concatenate([a.log_weight + evidence_a, b.log_weight + evidence_b]),
        np.concatenate([a.remembered, b.remembered]),
        np.concatenate([a.ground, b.ground]),
    )
    pf.normalise(made)
    return made


def project(model: ObservationModel, poses: Poses) -> Poses:
    """Samples (S, 3) in the sensor frame brought onto the contact manifold by one step (Marić et
    al. 2026). Samples that miss the object, or press deeper than a taxel can tell, are moved along
    the contact's normal; the others keep their depth, and so their spread."""
    ax, ay = contacts.axis_in_object(poses)
    radius_m = model.layout.radius_m
    distance, gx, gy = model.scene.clearance(ax, ay)
    step = -(distance - radius_m + np.clip(radius_m - distance, 0.0, model.depth_max_m))
    return contacts.pose_of_axis(ax + step * gx, ay + step * gy, poses[:, 2])


def _step(gain: Floats, most: float, kept: float) -> float:
    """The largest power of exp(gain), up to `most`, that leaves `kept` effective samples."""
    gain = gain - gain.max()
    add = np.add.reduce  # like `sum` with less overhead: this is called often

    def left(power: float) -> float:
        weight = np.exp(power * gain)
        total = float(add(weight))
        return total * total / float(weight @ weight)

    if left(most) >= kept:
        return most
    low, high = 0.0, most
    for _ in range(12):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if left(middle) >= kept else (low, middle)
    return high
