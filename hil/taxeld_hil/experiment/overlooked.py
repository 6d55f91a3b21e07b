"""How much likelier the true pose is than the estimate, by the daemon's own likelihood.

Where an object is not found, this tells why. A true pose that is far likelier was overlooked: a
search of all poses would have found it. If it is not likelier, no search could have told it from
the estimate: the touches so far, or the model, do not suffice.
"""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.mixture import Mixture

OVERLOOKED_NATS = 3.0  # a pose that is likelier by more is far likelier: 20 to 1
AROUND = np.array([0.004, 0.004, 0.06])  # sd [m, m, rad] of the first poses tried around one
SHARES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # the sd of each round, as shares of AROUND
TRIED = 400  # poses a round


def truth_nats(estimator: Estimator, truth: Poses) -> float | None:
    """How much likelier [nats] the best pose around the truth (3,) is than the best pose around the
    estimate; None: the estimator's rule remembers no touches."""
    if not isinstance(estimator.rule, Mixture):
        return None
    best = [_best(estimator.rule, pose) for pose in (truth, estimator.estimate.map)]
    return round(best[0] - best[1], 2)


def _best(rule: Mixture, pose: Poses) -> float:
    """The log posterior [nats] of the best pose that is found around a pose (3,)."""
    rng = np.random.default_rng(0)
    best = float(_log_posterior(rule, pose[None])[0])
    for share in SHARES:
        near = pose + share * AROUND * rng.standard_normal((TRIED, 3))
        found = _log_posterior(rule, near)
        if found.max() > best:
            best, pose = float(found.max()), near[found.argmax()]
    return best


def _log_posterior(rule: Mixture, poses: Poses) -> Floats:
    """(N,) log posterior [nats] of poses (N, 3), up to a constant."""
    return np.asarray(rule.memory.explain(poses) @ rule.memory.share)
