"""How reliable a belief is: contacts that confirm or refute it, and doubt about the newest.

A belief is *confirmed* by a firm contact that it explains and that leaves it narrow and in place.
It is *searched* when samples could have found a better place and did not. It is in *doubt* while no
pose explains the newest scan, or all remembered contacts together. A firm contact in doubt stays
*unexplained* until another contact is explained; silence does not change that. The belief was
*refuted* each time that contacts contradicted each other: on an object of another shape some
contacts agree, and others do not. All contacts before the oldest remembered one count once at most.
"""

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.estimate import SEARCHING_WEIGHT, Status, Summary, summarise
from taxeld.estimator.particles import Belief
from taxeld.model.observation import Observation
from taxeld.model.scene import Scene
from taxeld.model.symmetry import PoseMetric

CONFIRMED_M = 0.02  # the heaviest mode stayed if it moved less; scaled with a smaller object
LEAST = 3  # contacts, unless the place was known: most objects explain any two contacts somewhere
AGREEING = 4  # remembered contacts needed for each refuted one: a few agree by chance
FIRM = 0.05  # share of full scale: a lighter contact may be noise, or the beginning of a press
ROUNDING = 1e-15  # weights that differ by less count as equal
SEARCHED = 100  # samples that must have left a narrow belief where it was


@dataclass(slots=True)
class Confidence:
    """Follows one belief."""

    metric: PoseMetric
    summary: Summary  # summary of the current belief
    agreeing: int  # agreeing contacts needed for each refuted one
    enough: int  # samples needed
    least: int  # contacts needed where nothing was known before
    doubt: bool = False
    doubted: int = 0  # contacts in a row that ended in doubt
    unexplained: bool = False  # a firm contact was not explained, and no contact has been since
    refuting: list[int] = field(default_factory=list)  # a contact's number for each refutation
    searched: int = 0  # samples in a row that left a narrow belief where it was
    confirmed: bool = False  # the last contact confirmed the belief, and every search since did
    remembered: int = 0  # contacts that the belief explains
    known: bool = False  # the belief also explains what was known before the remembered contacts
    _contact: int = 0  # the contact judged last: one contact confirms once
    _summed: tuple[Poses, Floats] | None = None  # poses and weights behind `summary`

    @classmethod
    def of(
        cls,
        belief: Belief,
        scene: Scene,
        agreeing: int = AGREEING,
        enough: int = SEARCHED,
        least: int = LEAST,
    ) -> Self:
        """The confidence in a new belief about the object of a scene."""
        metric = PoseMetric(scene)
        return cls(metric, summarise(belief, metric), agreeing, enough, least)

    def learned(
        self,
        belief: Belief,
        samples: int,
        contact: int,
        remembered: int,
        oldest: int = 0,
        *,
        in_doubt: bool,
        known: bool = False,
    ) -> None:
        """The belief has learned from a scan. `contact`: the number of the scan's contact, from 1;
        0 where the scan is not firm. `remembered`: contacts in memory, the first of them number
        `oldest`. `in_doubt`: whether the belief was in doubt before; `known`: whether a prior is
        remembered."""
        stayed = self._search(belief, samples)
        self.remembered, self.known = remembered, known
        since = [number for number in self.refuting if number >= oldest]
        self.refuting = since or self.refuting[-1:]
        if contact and contact != self._contact:
            self._contact = contact
            self.confirmed = stayed and not in_doubt

    def revisited(self, belief: Belief, samples: int) -> None:
        """The belief has changed by samples of a remembered contact, and nothing new was read."""
        self.confirmed &= self._search(belief, samples)

    def moved(self, belief: Belief) -> None:
        """The object was pushed, and the belief moved with it."""
        self._summarise(belief)
        self.confirmed, self.remembered = False, 0

    def judged(self, *, doubt: bool, is_firm: bool = True) -> None:
        """A contact has ended, in doubt or not."""
        self.doubt = doubt
        self.unexplained = doubt and (is_firm or self.unexplained)
        self.doubted = self.doubted + 1 if doubt else 0

    def contradicted(self, contact: int, times: int = 0) -> None:
        """Contact number `contact` has refuted remembered scans; `times`: refuted contacts."""
        self.refuting += [contact] * max(times, 0 if self.refuting else 1)

    @property
    def is_searched(self) -> bool:
        return self.searched >= self.enough

    @property
    def is_sure(self) -> bool:
        """Whether enough samples and, where it matters, enough contacts agree."""
        least = 0 if self.known else self.least
        agree = self.remembered >= max(least, self.agreeing * len(self.refuting))
        return agree and self.is_searched

    def _search(self, belief: Belief, samples: int) -> bool:
        """Whether a change by this number of samples left a narrow belief in place."""
        before = self.summary
        self._summarise(belief)
        stayed = before.is_narrow and self.summary.is_narrow
        if stayed:
            apart = self.metric.distance(before.modes[0].pose, self.summary.modes[0].pose)
            stayed = bool(apart < CONFIRMED_M * min(self.metric.scale, 1.0))
        self.searched = self.searched + samples if stayed else 0
        return stayed

    def _summarise(self, belief: Belief) -> None:
        """Update the summary, unless nothing has changed: most silence changes only particles
        without weight."""
        pose, weight = belief.pose, belief.weight
        if self._summed is not None:
            at, weighed = self._summed
            same = len(weight) == len(weighed) and np.abs(weight - weighed).max() <= ROUNDING
            if same and np.array_equal(pose, at):
                return
        self.summary = summarise(belief, self.metric)
        self._summed = pose.copy(), weight


def firm(observation: Observation, contact: int) -> int:
    """The contact's number if this scan of it is firm; else 0."""
    return contact if is_firm(observation) else 0


def is_firm(observation: Observation) -> bool:
    return bool(observation.z.max() >= FIRM)


def status(confidence: Confidence, contacts: int, *, blind: bool = False) -> Status:
    """The status after this number of contacts. `blind`: no taxel is live where the best pose
    expects contact."""
    summary = confidence.summary
    if blind:
        return Status.BLIND
    if not contacts:
        return Status.SEARCHING
    if confidence.doubt or confidence.unexplained:
        return Status.INCONSISTENT
    if summary.is_narrow and confidence.confirmed and confidence.is_sure:
        return Status.CONVERGED
    weak = summary.modes[0].weight < SEARCHING_WEIGHT
    return Status.SEARCHING if weak else Status.AMBIGUOUS
