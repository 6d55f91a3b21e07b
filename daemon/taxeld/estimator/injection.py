"""How samples of a contact enter the belief.

A sample of p(q | contact) takes no other scan into account. The paper still gives it the mean
weight, so a right belief can lose to samples that explain only the present contact (`paper`). Here
the samples are first *annealed* into a second opinion of the whole posterior, which is merged with
the belief by its evidence.
"""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator import particles as pf
from taxeld.estimator.particles import Belief, Explain, Support
from taxeld.model import contacts
from taxeld.model.observation import ObservationModel

KEPT = 0.25  # share of the samples that remains effective after a stage of annealing
STAGES_MAX = 6  # the last stage takes all that is left


def anneal(
    samples: Poses,
    own: Support,
    support: Support,
    explain: Explain,
    rng: np.random.Generator,
    scale: float = 1.0,
) -> Belief:
    """Bring equally likely samples (S, 3) of log-density `own` to `support`. The difference is
    added by degrees, and after each step the samples are drawn anew and moved (an SMC sampler, Del
    Moral et al. 2006). A step is as large as leaves the share KEPT of them effective. `scale`: the
    object's size over the usual.
    """
    opinion, n, degree = pf.equal(samples, explain(samples)), len(samples), 0.0

    def between(explained: Floats) -> Floats:
        return np.asarray((1.0 - degree) * own(explained) + degree * support(explained))

    for stage in range(STAGES_MAX):
        gain = support(opinion.remembered) - own(opinion.remembered)
        left = 1.0 - degree
        step = left if stage == STAGES_MAX - 1 else _step(gain, left, KEPT * n)
        opinion.log_weight = step * gain
        pf.normalise(opinion)
        opinion = pf.resample(opinion, n, rng)
        degree += step
        pf.rejuvenate(opinion, explain, between, rng, scale)
        if step == left:
            break
    return opinion


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
