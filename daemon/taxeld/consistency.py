"""Whether any pose explains what was felt: deviances of remembered scans from what is usual.

A pose lacks what separates its likelihood from that of taxels pressed just as they read. A single
scan may lack what the true pose lacks in one of 1000 touches; all touches together may lack little
more than they usually do, which a wrong object of about the right shape does not pass.
"""

import math

import numpy as np
from numpy.typing import NDArray

from taxeld.filter import Belief
from taxeld.memory import Memory

Floats = NDArray[np.float64]

LACK_MAX, LACK_TAXEL = 10.0, 1.0  # nats that a scan, and each taxel that felt, may lack
USUAL_LACK, USUAL_TAXEL = 2.0, 0.55  # nats that a touch, and each of its taxels, usually lack
USUAL_SPREAD = 3.5  # of the sum over touches, times the root of its taxels: 3.1 at most in 120 seen


def lack(memory: Memory, weight: Floats, remembered: Floats) -> Floats:
    """(K,) nats by which each remembered scan is explained worse than is allowed."""
    allowed = LACK_MAX + LACK_TAXEL * memory.felt
    return np.asarray(memory.ceiling - allowed - weight @ remembered)


def is_too_much(memory: Memory, belief: Belief) -> bool:
    """Whether the remembered touches together are explained worse than is allowed, though each
    alone may pass: a wrong object of about the right shape."""
    touch = memory.touch
    touches, felt = int(np.count_nonzero(touch)), float(memory.felt[touch].sum())
    missing = float((memory.ceiling - belief.weight @ belief.remembered)[touch].sum())
    usual = USUAL_LACK * touches + USUAL_TAXEL * felt
    return touches > 1 and missing > usual + USUAL_SPREAD * math.sqrt(felt)
