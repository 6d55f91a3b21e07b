"""Proposals in order of preference, and which of them the time left carries.

Steps down: the chosen sampler, then cheaper ones, then fewer samples, then the table, then none.
Each call steps down as far as it must and no further, so there is nothing to undo: with room again
the next call is whole. What a rung costs is measured at start and followed while it is used; where
it was too dear, the measurement of the start is believed again bit by bit, so that it gets its try.
A machine too slow for any sample still gets the fewest now and then: late is better than never.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from taxeld.proposals import Bools, Floats, Proposal
from taxeld.se2 import Poses

MARGIN = 1.25  # of the expected cost that must be left
DEVIATIONS = 2.0  # mean absolute ones that the expected cost is over the mean
GAIN = 0.25  # of a new cost against what was expected
SURPRISE = 3.0  # times what was expected: more is believed to be someone else's work
PATIENCE = 5  # calls in a row that may bring no sample
FORGET = 0.05  # of what was learned, with each call that it keeps away
OVERHEAD = 100  # samples that cost the filter as much as their being there at all


class Step(IntEnum):
    """How far down a proposal had to step."""

    CHOSEN = 0
    CHEAPER = 1  # another sampler
    FEWER = 2  # samples, of the cheapest sampler
    TABLE = 3
    NONE = 4  # no samples this time


@dataclass(slots=True)
class Cost:
    """What something takes [ns]: a running mean and mean deviation, as TCP times its answers."""

    ns: float = 0.0
    deviation_ns: float = 0.0
    at_start_ns: float = 0.0

    @property
    def expected_ns(self) -> float:
        return self.ns + DEVIATIONS * self.deviation_ns

    def took(self, ns: float) -> None:
        if not self.ns:
            self.ns = ns
        off = min(ns, SURPRISE * self.ns) - self.ns
        self.ns += GAIN * off
        self.deviation_ns += GAIN * (abs(off) - self.deviation_ns)

    def kept_away(self) -> None:
        self.ns += FORGET * (self.at_start_ns - self.ns)
        self.deviation_ns *= 1.0 - FORGET


@dataclass(slots=True)
class Rung:
    """A proposal, the share of the samples it is asked for, and what that costs."""

    step: Step
    proposal: Proposal | None = None  # None: no samples
    share: float = 1.0
    cost: Cost = field(default_factory=Cost)


@dataclass(slots=True)
class LadderCounters:
    """Since start: proposals, by how far down they had to step."""

    chosen: int = 0
    cheaper: int = 0
    fewer: int = 0
    table: int = 0
    none: int = 0

    def count(self, step: Step) -> None:
        name = step.name.lower()
        setattr(self, name, getattr(self, name) + 1)


class Ladder:
    """A proposal that keeps to a deadline."""

    def __init__(
        self, rungs: list[Rung], clock: Callable[[], int], budget_ns: float = float("inf")
    ) -> None:
        """`rungs`: from the chosen one down; `clock`: ns; `budget_ns`: of proposing alone."""
        self.rungs = rungs
        self.clock = clock
        self.budget_ns = budget_ns
        self.deadline_ns = float("inf")  # on `clock`
        self.spent_ns = 0  # in proposals, since start
        self.step = Step.CHOSEN  # of the last call
        self.counters = LadderCounters()
        self.name = rungs[0].proposal.name if rungs[0].proposal else ""  # of the one last asked
        self._each = Cost()  # of the filter, with one sample
        self._done_ns = 0
        self._without = 0
        self._asked = 0

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """As `Proposal.propose`, but of as many samples as there is time for: (≤ n, 3)."""
        start = self.clock()
        left_ns = self.deadline_ns - start
        rung = next(rung for rung in self.rungs if self._fits(rung, n, left_ns))
        if rung.proposal is None and self._without >= PATIENCE:
            rung = self.rungs[-2]
        self.step = rung.step
        self.counters.count(rung.step)
        if rung.proposal is None:
            self._without += 1
            self._each.kept_away()
            return np.empty((0, 3))
        self._without = 0
        self._asked = max(round(rung.share * n), 1)
        poses = rung.proposal.propose(z, live, self._asked, rng)
        self._done_ns = self.clock()
        self.spent_ns += self._done_ns - start
        self.name = rung.proposal.name
        rung.cost.took(self._done_ns - start)
        return poses

    def used(self) -> None:
        """The filter is done with the samples of the last call: learn what it takes for them."""
        if self._asked:
            self._each.took((self.clock() - self._done_ns) / (OVERHEAD + self._asked))
        self._asked = 0

    def is_late(self) -> bool:
        return self.clock() >= self.deadline_ns

    def settle(self) -> None:
        """Warm now: costs are those of the start, and counting begins."""
        self.counters = LadderCounters()
        self.spent_ns = 0
        for cost in (self._each, *(rung.cost for rung in self.rungs)):
            cost.at_start_ns = cost.ns

    def _fits(self, rung: Rung, n: int, left_ns: float) -> bool:
        """Whether the time left carries a rung: the last one always."""
        if rung.proposal is None or left_ns == float("inf"):
            return True
        after_ns = self._each.expected_ns * (OVERHEAD + rung.share * n)
        fits = MARGIN * (rung.cost.expected_ns + after_ns) <= left_ns
        if rung.step is Step.CHOSEN and len(self.rungs) > 1:
            fits = fits and rung.cost.ns <= self.budget_ns
        if not fits:
            rung.cost.kept_away()
        return fits
