"""What may be where: poses drawn from the belief, and others that it may have lost.

A filter that has lost a mode would ask for touches that tell nothing of it. So beside its particles
there are fresh samples of remembered contacts, brought to explain all that is remembered, but less
strictly.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Floats, Index, Poses
from taxeld.estimator import particles as pf
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.particles import Belief

DOUBT = 0.5  # weight of all that are beside it, at most: as much as the estimate is in doubt
OWN, FRESH = 24, 16  # guesses from the belief, and beside it
TEMPER = 0.3  # power of the likelihood by which these are drawn
GROUPS, GROUP = 3, 32  # of samples, and how many are brought there at once


@dataclass(frozen=True, slots=True)
class Guesses:
    """K poses of objects in the world. The first ones are the estimate's modes, without weight: no
    approach may hit them either."""

    pose: Poses  # (K, 3)
    object: Index  # (K,) number of the object
    weight: Floats  # (K,) of sum 1
    modes: int

    @property
    def objects(self) -> list[int]:
        """The numbers of all objects among them."""
        return sorted(set(self.object.tolist()))


def drawn(estimator: Estimator, rng: np.random.Generator) -> Guesses:
    """Guesses of the present belief: OWN of its particles, and FRESH ones."""
    bank = estimator.bank
    likely = bank.likely
    share = bank.odds.objects[likely] / bank.odds.objects[likely].sum()
    doubt = min(1.0 - estimator.estimate.p, DOUBT)
    poses, numbers, weights = [], [], []

    def add(k: int, belief: Belief, n: int, weight: float) -> None:
        n = max(n, 1)
        poses.append(pf.resample(belief, n, rng).pose)
        numbers.append(np.full(n, k))
        weights.append(np.full(n, weight / n))

    for k, of in zip(likely, share.tolist(), strict=True):
        add(k, bank.rules[k].belief, round(OWN * of), (1.0 - doubt) * of)
        other = _fresh(estimator, k, rng)
        if other is not None:
            # as likely as the belief is wrong, whichever object it is of
            add(k, other, FRESH // len(likely), doubt / len(likely))
    modes = estimator.estimate.modes
    weight = np.concatenate(weights)
    return Guesses(
        np.concatenate([[mode.pose for mode in modes], *poses]),
        np.concatenate([[mode.object for mode in modes], *numbers]).astype(np.intp),
        np.concatenate([np.zeros(len(modes)), weight / weight.sum()]),
        len(modes),
    )


def _fresh(estimator: Estimator, k: int, rng: np.random.Generator) -> Belief | None:
    """Samples of object k; None where it was not touched."""
    rule, made = estimator.bank.rules[k], list[Belief]()
    memory = rule.memory
    for scan in rng.permutation(np.flatnonzero(memory.contact))[:GROUPS].tolist():
        samples = estimator.known[k].drawn(memory.scans[scan].remembered, GROUP, rng)
        if len(samples):
            made.append(rule.opinion(samples, scan, rng, TEMPER))
    if not made:
        return None
    belief = pf.equal(
        np.concatenate([each.pose for each in made]),
        np.concatenate([each.remembered for each in made]),
    )
    pf.reweight(belief, TEMPER * memory.runs.support(belief.remembered))
    return belief
