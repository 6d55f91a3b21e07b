"""Whether any pose explains the readings: how far remembered scans deviate from the usual.

The deviance of a pose is how far its likelihood falls short of the likelihood that every taxel was
pressed just as it reads. A single scan may deviate as much as the true pose does in one of 1000
contacts. All contacts together may deviate only a little more than usual: a wrong object of about
the right shape exceeds that. Chance averages out over many taxels. The deviation of a soft,
uncalibrated skin does not, so it is allowed for each taxel, however many there are.
"""

import math

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.estimator.memory import Memory
from taxeld.estimator.particles import Belief

MOST, MOST_TAXEL = 10.0, 1.0  # nats allowed to a scan or prior, and to each pressed taxel
USUAL, USUAL_TAXEL = 2.0, 0.55  # nats that a contact and each of its taxels deviate by usually
# nats of the sum over contacts, per root of its taxels; the most seen in 120 runs was 3.1
USUAL_SPREAD = 3.5
USUAL_BIAS = 0.5  # nats a taxel by which all taxels of a soft skin may deviate alike


def excess(memory: Memory, belief: Belief) -> Floats:
    """(K,) nats by which each remembered scan deviates more than allowed; above 0 no believed pose
    explains it."""
    allowed = MOST + MOST_TAXEL * memory.pressed
    return np.asarray(deviance(memory, belief) - allowed)


def refutes_prior(memory: Memory, belief: Belief) -> bool:
    """Whether the belief has left what was known before the remembered scans."""
    prior = memory.prior
    if prior is None:
        return False
    return bool(prior.ceiling - belief.weight @ belief.remembered[:, 0] > MOST)


def contradictions(memory: Memory, kept: Bools) -> int:
    """The number of refuted contacts, which have no scan in `kept` (K,). All refuted contacts
    before the agreeing ones count as one, because an object that moved leaves them all behind."""
    agreeing = memory.number[memory.contact & kept]
    refuted = np.setdiff1d(memory.number[memory.contact], agreeing)
    among = refuted > agreeing.min()
    return int(np.count_nonzero(among)) + bool(not among.all())


def is_excessive(memory: Memory, belief: Belief) -> bool:
    """Whether the remembered contacts together deviate more than allowed, though each alone may
    pass, as with a wrong object of about the right shape. Each contact counts once, however many
    scans it has."""
    contact = memory.contact
    share = memory.of_scans(memory.share)[contact]
    deviant = float(share @ deviance(memory, belief)[contact])
    taxels = float(share @ memory.pressed[contact])
    contacts = memory.contacts
    usual = USUAL * contacts + USUAL_TAXEL * taxels
    allowed = math.hypot(USUAL_SPREAD * math.sqrt(taxels), USUAL_BIAS * taxels)
    return contacts > 1 and deviant > usual + allowed


def deviance(memory: Memory, belief: Belief) -> Floats:
    """(K,) deviance of each remembered scan [nats]."""
    return np.asarray(memory.ceiling - belief.weight @ memory.of_scans(belief.remembered))
