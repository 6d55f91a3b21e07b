"""How much likelier the truth is than what the daemon believes, by the daemon's own likelihood.

Where an object is not found this tells why. A truth that is far likelier was overlooked: a full
scan of all poses would have found it. One that is not cannot be told from the touches so far,
whatever searches: that is the limit of what was touched and of the model.
"""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.mixture import Mixture

OVERLOOKED_NATS = 3.0  # by which a pose is far likelier: 20 to 1
AROUND = np.array([0.004, 0.004, 0.06])  # sd [m, m, rad] of poses tried about the best so far,
SHARES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # times these, one after the other
TRIED = 400  # poses each


def truth_nats(estimator: Estimator, truth: Poses) -> float | None:
    """[nats] of the likeliest pose about the truth (3,), over the likeliest about the estimate;
    None: the estimator's rule remembers no touches."""
    if not isinstance(estimator.rule, Mixture):
        return None
    best = [_best(estimator.rule, pose) for pose in (truth, estimator.estimate.map)]
    return round(best[0] - best[1], 2)


def _best(rule: Mixture, pose: Poses) -> float:
    rng = np.random.default_rng(0)
    best = float(_log_posterior(rule, pose[None])[0])
    for share in SHARES:
        near = pose + share * AROUND * rng.standard_normal((TRIED, 3))
        found = _log_posterior(rule, near)
        if found.max() > best:
            best, pose = float(found.max()), near[found.argmax()]
    return best


def _log_posterior(rule: Mixture, poses: Poses) -> Floats:
    """(N,) of poses (N, 3), but for a constant."""
    return np.asarray(rule.memory.explain(poses) @ rule.memory.share)
