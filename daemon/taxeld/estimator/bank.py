"""Which of several known objects is felt: a belief for each, and one posterior over them all.

Every object explains the same contacts, in relation to readings without it, so their evidence can
be compared. The likeliest learn from each scan at once. The others learn while there is nothing
else to do, one scan at a time. An object that is ruled out learns no more and costs nothing, until
no known object explains the contacts: then it is tried again on all that is remembered.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.estimate import MODES_MAX, Hypotheses, Verdict
from taxeld.estimator.evidence import MOVED, SWAPPED, odds
from taxeld.estimator.object_belief import ObjectBelief
from taxeld.estimator.scans import ScanEvidence
from taxeld.model import contacts, se2
from taxeld.model.contacts import Proposal
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.symmetry import Mode
from taxeld.prior import PosePrior

FOLLOWED = 2  # objects that learn from every scan at once
RULED_OUT = 1e-4  # probability below which an object learns no more
LEAST_SHARE = 1e-100  # of an object's probability, so that it has a logarithm
DOUBTED = 0.01  # probability from which an object has modes, and is searched


@dataclass(frozen=True, slots=True)
class Known:
    """An object that may be felt, and samples of its poses."""

    model: ObservationModel
    proposal: Proposal
    beside: Sequence[Proposal] = ()  # samples of contacts on further links

    def on(self, link: int) -> tuple[ObservationModel, Proposal]:
        """The object on a link, and samples of its contacts there."""
        return self.model.links[link], self.beside[link - 1] if link else self.proposal

    def drawn(self, observation: Observation, n: int, rng: np.random.Generator) -> Poses:
        """At most n poses (≤ n, 3) in the world that explain an observation by itself."""
        model, proposal = self.on(observation.link)
        z, live = observation.z, observation.live
        if observation.noise is not None:  # a silence that is the taxel's own tells nothing
            live = live & (observation.noise.quiet(z) < 0.5)
        poses = proposal.propose(z, live, n, rng)
        poses = poses[np.isfinite(poses).all(axis=1)]
        return se2.compose(observation.sensor, touching(model, poses))


def touching(model: ObservationModel, poses: Poses) -> Poses:
    """Samples (S, 3) in the sensor frame brought onto the contact manifold by one step (Marić et
    al. 2026). Samples that miss the object, or press deeper than a taxel can tell, are moved along
    the contact's normal; the others keep their depth, and so their spread."""
    ax, ay = contacts.axis_in_object(poses)
    radius_m = model.layout.radius_m
    distance, gx, gy = model.scene.clearance(ax, ay)
    step = -(distance - radius_m + np.clip(radius_m - distance, 0.0, model.depth_max_m))
    return contacts.pose_of_axis(ax + step * gx, ay + step * gy, poses[:, 2])


class Bank:
    """Beliefs about K objects."""

    def __init__(self, beliefs: Sequence[ObjectBelief], first: int = 0) -> None:
        """`first`: the object that is followed until something is touched."""
        self.beliefs = list(beliefs)
        self.best = first
        self.ruled_out: set[int] = set()
        self._followed = [first]
        self._contact = self._touches = 0  # number of the last contact, and how many there were
        self._restarted = -1  # number of the last contact that an earlier daemon felt
        self._weigh()

    @property
    def belief(self) -> ObjectBelief:
        """The belief about the likeliest object."""
        return self.beliefs[self.best]

    @property
    def verdict(self) -> Verdict:
        """Where the likeliest object is, and how likely."""
        here, left = float(self.odds.here[self.best]), self.odds.hypotheses
        if self._contact <= self._restarted:  # no touch since says that it was not moved
            here *= 1.0 - MOVED
            stands = left.stands * (1.0 - MOVED)
            left = Hypotheses(stands, left.moved + left.stands - stands, left.other)
        return Verdict(self.belief.place, here, left)

    def restarted(self, contact: int) -> None:
        """All so far, up to this contact, was felt by an earlier daemon: the object may have been
        moved since."""
        self._restarted = contact
        for belief in self.beliefs:
            belief.memory = replace(belief.memory, moves={contact + 1: float(np.log(MOVED))})

    def modes(self) -> tuple[Mode, ...]:
        """The heaviest modes of all objects; those of the likeliest object come first."""
        own = self.belief.place.modes
        if len(self.beliefs) == 1:
            return own
        every = [
            replace(mode, weight=self.beliefs[k].share * mode.weight, object=k)
            for k in self.likely
            for mode in self.beliefs[k].place.modes
        ]
        rest = sorted(every[len(own) :], key=lambda mode: -mode.weight)
        return (*every[: len(own)], *rest)[:MODES_MAX]

    @property
    def likely(self) -> list[int]:
        """The likeliest object, and others that are not much less likely."""
        others = (k for k in self._by_odds() if k != self.best)
        # one that has scans to learn may seem likelier
        return [self.best, *(k for k in others if self.odds.objects[k] >= DOUBTED)]

    def follow(self, before: Observation, after: Observation) -> None:
        """Move the beliefs with an object that is pushed from one scan to the next."""
        for k in self._followed:
            self.beliefs[k].follow(before, after)

    def take(self, scan: ScanEvidence) -> tuple[int, float]:
        """Learn from a scan; → the number of samples injected, and the scan's log evidence for the
        object that was the likeliest before."""
        injected, evidence = 0, 0.0
        is_new = scan.is_contact and scan.number > self._contact
        if is_new:
            self._contact = scan.number
            self._touches += 1
        for k, belief in enumerate(self.beliefs):
            if k in self._followed:
                samples, log_p = belief.take(scan)
                injected += samples
                evidence = log_p if k == self.best else evidence
            elif self._touches and k not in self.ruled_out:
                belief.pending.append(scan)
        if is_new or injected or evidence:  # else nothing was learned
            self._weigh()
        # whether no likely object explains the contacts
        if is_new and self._touches > 1 and self.odds.hypotheses.stands < 0.5:
            for k in self.ruled_out:
                self.beliefs[k].pending.append(scan)
        return injected, evidence

    def take_prior(self, pose: PosePrior, contacts: int, of: Sequence[int]) -> None:
        """Take a prior of the objects `of`, after this number of contacts."""
        for k in of:
            self.beliefs[k].take_prior(pose, contacts)
        self._weigh()

    @property
    def is_behind(self) -> bool:
        """Whether a likely object has scans to learn."""
        return any(k not in self.ruled_out for k in self._behind())

    @property
    def is_open(self) -> bool:
        """Whether `revisit` may find anything."""
        return bool(self._behind()) or self._opens() is not None

    def revisit(self) -> int | None:
        """Have the likeliest object with scans to learn take the next one, or search for another
        place; → the number of samples used; None where no verdict is due."""
        behind = self._behind()
        if behind:
            belief = self.beliefs[behind[0]]
            if behind[0] in self.ruled_out or not len(belief.memory):
                self.ruled_out.discard(behind[0])
                samples = belief.adopt(self.belief.memory)
            else:
                samples = belief.take(belief.pending.popleft())[0]
            if belief.pending:
                return None
        else:
            opens = self._opens()
            samples = 0 if opens is None else self.beliefs[opens].search()
            if not samples:
                return None
        self._weigh()
        return None if self.is_behind else samples

    def _by_odds(self) -> list[int]:
        """All objects, the likeliest first."""
        return sorted(range(len(self.beliefs)), key=lambda k: -self.odds.objects[k])

    def _behind(self) -> list[int]:
        """The objects with scans to learn, the likeliest first."""
        return [k for k in self._by_odds() if self.beliefs[k].pending]

    def _opens(self) -> int | None:
        """The likeliest followed object whose belief is to be searched."""
        likely = (k for k in self.likely if k in self._followed)
        return next((k for k in likely if self.beliefs[k].is_open), None)

    def _weigh(self) -> None:
        """Find how likely each object is, which ones to follow, and which are ruled out."""
        best, each = self.belief, [belief.evidence for belief in self.beliefs]
        if not self._touches:
            each = [best.evidence] * len(each)
        current = {k for k, belief in enumerate(self.beliefs) if not belief.pending}
        current -= self.ruled_out
        for k in set(range(len(each))) - current:  # as likely as it was, beside the best
            ratio = max(self.beliefs[k].share, LEAST_SHARE) / best.share
            each[k] = each[k].shifted(best.evidence.log_z + math.log(ratio))
        self.odds = odds(each)
        if len(each) == 1:
            return
        any_known = float(np.logaddexp.reduce([one.log_z for one in each])) - np.log(len(each))
        share = self.odds.objects / self.odds.objects.sum()
        for k, belief in enumerate(self.beliefs):
            belief.share = float(share[k])
            if k in current:  # another object may have been here before
                belief.log_z = float(np.logaddexp(each[k].log_z, any_known + SWAPPED))
        learned = [k for k in self._by_odds() if k in current]
        if self._touches > 1:
            self.ruled_out |= {k for k in learned[1:] if self.odds.objects[k] < RULED_OUT}
        if self._touches:
            self.best = learned[0]
            self._followed = [k for k in learned[:FOLLOWED] if k not in self.ruled_out]
