"""Whether any pose explains what was read: deviances of remembered scans from what is usual.

The deviance of a pose is by how much its likelihood falls short of that of taxels pressed just as
they read. A single scan may deviate as much as the true pose does in one of 1000 contacts. All
contacts together may deviate little more than they usually do: a wrong object of about the right
shape does not pass that. What chance adds averages out over many taxels. What a soft skin adds that
nobody has calibrated does not: each taxel may deviate by so much more, however many there are.
"""

import math

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.estimator.memory import Memory
from taxeld.estimator.particles import Belief

MOST, MOST_TAXEL = 10.0, 1.0  # nats that a scan or prior, and each pressed taxel, may deviate
USUAL, USUAL_TAXEL = 2.0, 0.55  # nats that a contact, and each of its taxels, usually deviate
USUAL_SPREAD = (
    3.5  # of the sum over contacts, times the root of its taxels: 3.1 at most in 120 seen
)
USUAL_BIAS = 0.5  # nats more that all taxels of a soft skin may deviate by alike


def excess(memory: Memory, belief: Belief) -> Floats:
    """(K,) nats by which each remembered scan deviates more than is allowed; above 0: no pose that
    is believed explains it."""
    allowed = MOST + MOST_TAXEL * memory.pressed
    return np.asarray(deviance(memory, belief) - allowed)


def refutes_prior(memory: Memory, belief: Belief) -> bool:
    """Whether the belief has left what was known before the remembered scans."""
    prior = memory.prior
    if prior is None:
        return False
    return bool(prior.ceiling - belief.weight @ belief.remembered[:, 0] > MOST)


def contradictions(memory: Memory, kept: Bools) -> int:
    """How many times contacts are refuted that `kept` (K,) leaves no scan of. Each is one; but all
    before those that agree are one together: an object that has moved leaves them behind."""
    agreeing = memory.number[memory.contact & kept]
    refuted = np.setdiff1d(memory.number[memory.contact], agreeing)
    among = refuted > agreeing.min()
    return int(np.count_nonzero(among)) + bool(not among.all())


def is_excessive(memory: Memory, belief: Belief) -> bool:
    """Whether the remembered contacts together deviate more than is allowed, though each alone may
    pass: a wrong object of about the right shape. A contact counts once, however many scans are of
    it."""
    contact = memory.contact
    share = memory.of_scans(memory.share)[contact]
    deviant = float(share @ deviance(memory, belief)[contact])
    taxels = float(share @ memory.pressed[contact])
    contacts = memory.contacts
    usual = USUAL * contacts + USUAL_TAXEL * taxels
    allowed = math.hypot(USUAL_SPREAD * math.sqrt(taxels), USUAL_BIAS * taxels)
    return contacts > 1 and deviant > usual + allowed


def deviance(memory: Memory, belief: Belief) -> Floats:
    """(K,) nats of each remembered scan."""
    return np.asarray(memory.ceiling - belief.weight @ memory.of_scans(belief.remembered))
