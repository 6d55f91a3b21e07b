"""Which of several known objects is felt: a belief for each, and one posterior over them all.

Every object explains the same contacts, in relation to readings without it, so their evidence can
be compared. An object that is ruled out learns no more and costs nothing. When no known object
explains the contacts, those that were ruled out are tried again on all that is remembered, one at a
time, while there is nothing else to do.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from taxeld.arrays import Floats
from taxeld.estimator.estimate import MODES_MAX
from taxeld.estimator.evidence import Odds, Weighed, odds
from taxeld.estimator.mixture import Mixture
from taxeld.estimator.rule import Draw, Rule
from taxeld.estimator.runs import SWAPPED
from taxeld.estimator.verdict import Verdict
from taxeld.model.lesson import Lesson
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.model.symmetry import Mode

RULED_OUT = 1e-4  # probability below which an object learns no more
DOUBTED = 0.01  # probability from which an object is given second opinions


@dataclass(frozen=True, slots=True)
class Known:
    """An object that may be felt, and samples of its poses."""

    model: ObservationModel
    proposal: Proposal


class Bank:
    """Beliefs about K objects, by the same rule."""

    def __init__(self, rules: Sequence[Rule], draws: Sequence[Draw]) -> None:
        self.rules = list(rules)
        self._draws = draws
        self._asleep: dict[int, Weighed] = {}  # ruled out, with the evidence that they had
        self._due: list[int] = []  # ruled out, and to be tried again
        self._contact = 0  # number of the contact after which that was decided
        self.best = 0
        self._weigh()

    @property
    def rule(self) -> Rule:
        """The rule of the likeliest object."""
        return self.rules[self.best]

    @property
    def awake(self) -> list[int]:
        """Objects that learn, the likeliest first."""
        left = [k for k in range(len(self.rules)) if k not in self._asleep]
        return sorted(left, key=lambda k: -self.odds.objects[k])

    @property
    def objects(self) -> Floats:
        """(K,) probabilities of the objects."""
        return self.odds.objects

    @property
    def verdict(self) -> Verdict:
        return Verdict(self.rule.place, float(self.odds.here[self.best]), self.odds.hypotheses)

    def modes(self) -> tuple[Mode, ...]:
        """The heaviest modes of all objects; those of the likeliest object come first."""
        own = self.rule.place.summary.modes
        if len(self.rules) == 1:
            return own
        share = self.objects / self.objects.sum()
        every = [
            replace(mode, weight=float(share[k]) * mode.weight, object=k)
            for k in self.awake
            for mode in self.rules[k].place.summary.modes
        ]
        rest = sorted(every[len(own) :], key=lambda mode: -mode.weight)
        return (*every[: len(own)], *rest)[:MODES_MAX]

    def follow(self, before: Observation, after: Observation) -> None:
        """Move the beliefs with an object that is pushed from one scan to the next."""
        for k in self.awake:
            self.rules[k].follow(before, after)

    def learn(self, observation: Observation, contacts: int) -> tuple[int, float]:
        """As `Rule.learn`; the log evidence is of the object that was the likeliest before."""
        injected, evidence, best = 0, 0.0, self.best
        for k in self.awake:
            samples, told = self.rules[k].learn(observation, contacts, self._draws[k])
            injected += samples
            evidence = told if k == best else evidence
        self._weigh()
        if len(self.rules) > 1 and observation.is_contact and contacts > 1:
            self._rule_out()
            self._ask(contacts)
        return injected, evidence

    def expected(self, after: int) -> Lesson | None:
        """As `Rule.expected`, of the likeliest object."""
        return self.rule.expected(after)

    @property
    def is_open(self) -> bool:
        """Whether `revisit` may find anything."""
        return bool(self._due) or self._opens() is not None

    def revisit(self) -> int:
        """Try an object again that was ruled out, or take a second opinion; → the number of samples
        used."""
        samples = 0
        if self._due:
            samples = self._try_again(self._due.pop(0))
        elif (k := self._opens()) is not None:
            samples = self.rules[k].revisit(self._draws[k])
        if samples:
            self._weigh()
        return samples

    def _opens(self) -> int | None:
        """The likeliest object whose belief is open to a second opinion."""
        likely = (k for k in self.awake if k == self.best or self.objects[k] >= DOUBTED)
        return next((k for k in likely if self.rules[k].is_open), None)

    def _weigh(self) -> None:
        """Find how likely each object is, and tell the rules."""
        each = [self._asleep.get(k, rule.weighed) for k, rule in enumerate(self.rules)]
        self.odds: Odds = odds(each)
        if len(each) == 1:
            return
        left = [k for k in range(len(each)) if k not in self._asleep]
        self.best = max(left, key=lambda k: self.objects[k])
        any_known = float(np.logaddexp.reduce([one.log_z for one in each])) - np.log(len(each))
        share = self.objects / self.objects.sum()
        for k in left:
            rule = self.rules[k]
            rule.share = float(share[k])
            if isinstance(rule, Mixture):  # another object may have been here before
                rule.log_z = float(np.logaddexp(rule.weighed.log_z, any_known + SWAPPED))

    def _rule_out(self) -> None:
        for k in self.awake:
            if k != self.best and self.objects[k] < RULED_OUT:
                self._asleep[k] = self.rules[k].weighed.fixed()

    def _ask(self, contact: int) -> None:
        """Have objects tried again that were ruled out, if no known one explains this contact."""
        if contact == self._contact:
            return
        self._contact = contact
        doubted = self.odds.hypotheses.stands < 0.5
        self._due = [k for k in self._asleep if doubted or self.objects[k] >= DOUBTED]

    def _try_again(self, k: int) -> int:
        rule, likeliest = self.rules[k], self.rule
        if not isinstance(rule, Mixture) or not isinstance(likeliest, Mixture):
            return 0
        samples = rule.adopt(likeliest.memory, self._draws[k])
        if samples:
            kept = self._asleep.pop(k)
            self._weigh()
            if k != self.best and self.objects[k] < RULED_OUT:
                self._asleep[k] = kept._replace(found=rule.weighed.found, gone=rule.weighed.gone)
        return samples
