"""Several objects at once: how many there are, and which touches are of which.

Each target has a bank of beliefs of its own, which learns from its touches and from all silence. A
target whose touches no single object explains is split in two, where two explain them far better.
The search is made in small steps, while there is nothing else to do.
"""

from collections.abc import Callable, Generator, Iterator, Sequence

import numpy as np

from taxeld.arrays import Floats
from taxeld.estimator.bank import Bank
from taxeld.estimator.estimate import Target
from taxeld.estimator.mixture import REMEMBERED, SILENT_MAX
from taxeld.model.observation import Observation

TWO = float(np.log(0.1))  # log odds of one object more before anything is felt
CLEAR = 7.0  # nats by which two objects must explain the touches better than one
LEAST_TOUCHES = 3  # of a target that may be two
PAIRED = 200  # poses that are tried in pairs
ROUNDS = 2  # times that touches are divided anew between two beliefs

Used = tuple[Observation, int]
"""A scan that was learned from, and the number of its contact or of the one before."""


class Targets:
    """One target at first, `most` at last."""

    def __init__(self, begin: Callable[[], Bank], most: int) -> None:
        self._begin, self._most = begin, most
        self.banks = [begin()]
        self._of: dict[int, Bank] = {}  # the target of each contact
        self._kept: list[Used] = []
        self._search: Iterator[None] | None = None

    def all(self) -> tuple[Target, ...]:
        """The targets, the one that was touched first coming first."""
        return tuple(bank.target() for bank in self.banks)

    def learn(self, observation: Observation, contacts: int) -> tuple[int, float]:
        """As `Bank.learn`: a touch is for the target that expects it most, silence for all."""
        if self._most == 1:
            return self.banks[0].learn(observation, contacts)
        self._keep(observation, contacts)
        if not observation.is_contact:
            first, *_ = [bank.learn(observation, contacts) for bank in self.banks]
            return first
        surprise = False
        if contacts not in self._of:
            expected = [bank.expectation(observation, contacts) for bank in self.banks]
            surprise = max(expected) < 0.0  # anything explains this touch better
            self._of[contacts] = self.banks[int(np.argmax(expected))]
        bank = self._of[contacts]
        if surprise and self._search is None and len(self.banks) < self._most:
            self._search = self._split(bank)
        return bank.learn(observation, contacts)

    @property
    def is_behind(self) -> bool:
        """Whether there is work that should not wait for the next touch."""
        return self._search is not None or any(bank.is_behind for bank in self.banks)

    @property
    def is_open(self) -> bool:
        return self.is_behind or any(bank.is_open for bank in self.banks)

    def revisit(self) -> int:
        """Do one piece of the work that waits; → the number of samples used."""
        behind = [bank for bank in self.banks if bank.is_behind]
        if not behind and self._search is not None:
            if next(self._search, self) is self:  # it has come to its end
                self._search = None
            return 1
        for bank in behind or self.banks:
            if bank.is_open:
                return bank.revisit()
        return 0

    def _keep(self, observation: Observation, contacts: int) -> None:
        """Keep a scan; of too many of its kind the oldest is dropped, unless a search needs it."""
        self._kept.append((observation, contacts))
        if self._search is not None:
            return
        for is_contact, most in ((True, REMEMBERED), (False, SILENT_MAX)):
            of = [used for used in self._kept if used[0].is_contact == is_contact]
            dropped = {id(used) for used in of[: max(len(of) - most, 0)]}
            self._kept = [used for used in self._kept if id(used) not in dropped]
        felt = {number for scan, number in self._kept if scan.is_contact}
        self._of = {number: bank for number, bank in self._of.items() if number in felt}

    def _split(self, bank: Bank) -> Iterator[None]:
        """Look for two targets in place of one, a piece of work at a time."""
        yield
        own = [number for number, of in self._of.items() if of is bank]
        if len(own) < LEAST_TOUCHES or bank.odds.hypotheses.stands >= 0.5:
            return
        known = set(own)
        first = yield from self._divided(bank, own)
        for _ in range(ROUNDS):
            if not first or len(first) == len(own):
                return
            pair = self._begin(), self._begin()
            yield from self._taught(pair, own, first)
            again = self._nearer(pair, own)
            if again == first:
                break
            first = again
        apart = len(own) * np.log(2.0) - TWO
        if pair[0].odds.log_z + pair[1].odds.log_z - apart < bank.odds.log_z + CLEAR:
            return
        # touches that came meanwhile are divided as well
        own = [number for number, of in self._of.items() if of is bank]
        late = [number for number in own if number not in known]
        first = first | (self._nearer(pair, late) if late else set())
        yield from self._taught(pair, late, first)
        for number in own:
            self._of[number] = pair[number not in first]
        at = self.banks.index(bank)
        self.banks[at : at + 1] = pair if min(own) in first else pair[::-1]

    def _divided(self, bank: Bank, own: Sequence[int]) -> Generator[None, None, set[int]]:
        """Contacts that one of two poses explains better than the other, as a set of numbers."""
        told: list[tuple[Floats, Floats]] = []
        scans, likely = self._scans(own), bank.likely
        most = max(PAIRED // (len(own) * len(likely)), 1)
        for touch, silence in self._begin().searched(scans, likely):
            alone = np.logaddexp(touch, 0.0).sum(axis=1) + silence
            best = np.argsort(-alone)[:most]  # of each contact, as one object may have the fewer
            told.append((touch[best], silence[best]))
            yield
        touch, silence = (np.concatenate(each) for each in zip(*told, strict=True))
        if not len(touch):  # no samples were asked for
            return set()
        both = np.logaddexp(touch[:, None], touch[None]).sum(axis=2) + silence[:, None] + silence
        one, other = np.unravel_index(both.argmax(), both.shape)
        numbers = np.array(sorted(own))
        return set(numbers[touch[one] >= touch[other]].tolist())

    def _scans(self, own: Sequence[int]) -> list[Used]:
        """Kept scans of some contacts, and silent ones."""
        return [used for used in self._kept if not used[0].is_contact or used[1] in own]

    def _taught(self, pair: Sequence[Bank], own: Sequence[int], first: set[int]) -> Iterator[None]:
        """Have two targets learn from their touches: the contacts in `first`, and the rest."""
        at = 0
        while at < len(scans := self._scans(own)):
            observation, number = scans[at]
            of = pair if not observation.is_contact else pair[:1] if number in first else pair[1:]
            for bank in of:
                bank.learn(observation, number)
            at += 1
            yield
        for bank in pair:
            while bank.is_open:
                bank.revisit()
                yield

    def _nearer(self, pair: Sequence[Bank], own: Sequence[int]) -> set[int]:
        """The contacts that the first of two targets expects more than the second."""
        found: dict[int, Floats] = {}
        for observation, number in self._scans(own):
            if observation.is_contact:
                told = np.array([bank.expectation(observation, number) for bank in pair])
                found[number] = found.get(number, 0.0) + told
        return {number for number, (one, other) in found.items() if one >= other}
