"""A proposal that keeps to a deadline: the first of several that fits into the time left.

The rungs, from the top: the chosen sampler, cheaper samplers, fewer samples, the table, no samples.
Every call begins at the top, so with enough time the next call is whole again. The cost of a rung
is measured at start and followed while it is used. A rung that is skipped for its cost moves back
towards its cost at start, so that it is tried again. Where no rung ever fits, the last one with
samples is still used now and then: late samples are better than none.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.proposal import Proposal

MARGIN = 1.25  # times the expected cost: time that must be left
DEVIATIONS = 2.0  # mean absolute deviations over the mean: the expected cost
GAIN = 0.25  # weight of a new cost in the running mean
SURPRISE = 3.0  # times the mean: any cost beyond it is taken for another process's work
PATIENCE = 5  # calls in a row that may bring no samples
FORGET = 0.05  # share of the way back to the cost at start, at each call that skips a rung
OVERHEAD = 100  # samples that cost the filter as much as its fixed work

ClockNs = Callable[[], int]


def no_clock() -> int:
    return 0


class Step(IntEnum):
    """How far down the ladder a call went."""

    CHOSEN = 0
    CHEAPER = 1  # another, cheaper sampler
    FEWER = 2  # fewer samples of the cheapest sampler
    TABLE = 3
    NONE = 4  # no samples this time


@dataclass(slots=True)
class Cost:
    """A running mean and mean absolute deviation of a duration [ns], as TCP keeps of round
    trips."""

    ns: float = 0.0
    deviation_ns: float = 0.0
    at_start_ns: float = 0.0
    least_ns: float = float("inf")

    @property
    def expected_ns(self) -> float:
        return self.ns + DEVIATIONS * self.deviation_ns

    def took(self, ns: float) -> None:
        if not self.ns:
            self.ns = ns
        self.least_ns = min(ns, self.least_ns)
        off = min(ns, SURPRISE * self.ns) - self.ns
        self.ns += GAIN * off
        self.deviation_ns += GAIN * (abs(off) - self.deviation_ns)

    def skipped(self) -> None:
        self.ns += FORGET * (self.at_start_ns - self.ns)
        self.deviation_ns *= 1.0 - FORGET


@dataclass(slots=True)
class Rung:
    """A proposal, its share of the wanted samples, and the cost of a call."""

    step: Step
    proposal: Proposal | None = None  # None: no samples
    share: float = 1.0
    cost: Cost = field(default_factory=Cost)


@dataclass(slots=True)
class LadderCounters:
    """Counts of calls since start, by the rung that they reached."""

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
        self, rungs: list[Rung], clock: ClockNs = no_clock, budget_ns: float = float("inf")
    ) -> None:
        """`rungs`: from the chosen one down; `budget_ns`: time for the proposal, without the
        filter."""
        self.rungs = rungs
        self.clock = clock
        self.budget_ns = budget_ns
        self.deadline_ns = float("inf")  # time on `clock`
        self.spent_ns = 0  # time in proposals, since start
        self.step = Step.CHOSEN  # rung of the last call
        self.counters = LadderCounters()
        self.name = rungs[0].proposal.name if rungs[0].proposal else ""  # proposal used last
        self._each = Cost()  # cost of the filter's work on one sample
        self._done_ns = 0  # time at which the last call's samples were done
        self._without = 0  # calls in a row without samples
        self._asked = 0  # samples wanted at the last call

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """Like `Proposal.propose`, with as many samples as fit the time: z (M,), live (M,) → (≤ n,
        3)."""
        start = self.clock()
        left_ns = self.deadline_ns - start
        rung = next(rung for rung in self.rungs if self._fits(rung, n, left_ns))
        if rung.proposal is None and self._without >= PATIENCE:
            rung = self.rungs[-2]
        self.step = rung.step
        self.counters.count(rung.step)
        if rung.proposal is None:
            self._without += 1
            self._each.skipped()
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
        """The filter has finished the last call's samples: learn its cost of a sample."""
        if self._asked:
            self._each.took((self.clock() - self._done_ns) / (OVERHEAD + self._asked))
        self._asked = 0

    def paused(self, ns: int) -> None:
        """The filter paused for `ns` with the last call's samples."""
        self._done_ns += ns

    def given_up(self) -> None:
        """The filter drops the last call's samples unfinished."""
        self._asked = 0

    def settle(self) -> None:
        """End the warm-up: counting begins, and the costs at start become the least so far, because
        cold code and other processes only ever add to them."""
        self.counters = LadderCounters()
        self.spent_ns = 0
        for cost in (self._each, *(rung.cost for rung in self.rungs)):
            cost.ns = cost.at_start_ns = min(cost.ns, cost.least_ns)
            cost.deviation_ns = 0.0

    def _fits(self, rung: Rung, n: int, left_ns: float) -> bool:
        """Whether a rung and the filter's work on its samples fit into `left_ns`."""
        if rung.proposal is None or left_ns == float("inf"):
            return True
        after_ns = self._each.expected_ns * (OVERHEAD + rung.share * n)
        fits = MARGIN * (rung.cost.expected_ns + after_ns) <= left_ns
        if rung.step is Step.CHOSEN and len(self.rungs) > 1:
            fits = fits and rung.cost.ns <= self.budget_ns
        if not fits:
            rung.cost.skipped()
        return fits
