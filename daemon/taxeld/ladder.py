"""Proposals in order of preference, and which of them the time left carries.

Rungs: the chosen sampler, then cheaper ones, then fewer samples, then none. Each call steps down as
far as it must and no further, so there is nothing to undo: with room again the next call is whole.
What a rung costs is measured at start and followed while it runs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from taxeld.proposals import Bools, Floats, Proposal
from taxeld.se2 import Poses

SHARES = (0.5, 0.25)  # of the samples, where the cheapest sampler with all of them is too much
MARGIN = 1.25  # of the expected cost that must be left
GAIN = 0.25  # of a new cost against what was expected
OVERHEAD = 100  # samples that cost the filter as much as their being there at all


@dataclass(slots=True)
class Rung:
    """A proposal, the share of the samples it is asked for, and its cost."""

    proposal: Proposal | None  # None: no samples
    share: float = 1.0
    cost_ns: float = 0.0


@dataclass(slots=True)
class LadderCounters:
    """Since start."""

    proposals: int = 0
    degraded: int = 0  # of them, those below the chosen sampler with all its samples
    skipped: int = 0  # of those, without any sample


@dataclass(slots=True)
class Ladder:
    """A proposal that keeps to a deadline."""

    rungs: list[Rung]
    clock: Callable[[], int]  # ns
    filter_ns: float = 0.0  # expected, of what the filter does with one sample
    budget_ns: float = float("inf")  # that proposing alone may take
    deadline_ns: int | None = None  # on `clock`; None: there is time
    spent_ns: int = 0  # in proposals, since start
    level: int = 0  # rung of the last call; 0: as chosen
    counters: LadderCounters = field(default_factory=LadderCounters)
    name: str = ""  # kind of the sampler last used
    _begun_ns: int = 0
    _asked: int = 0

    def __post_init__(self) -> None:
        if self.rungs[0].proposal is not None:
            self.name = self.rungs[0].proposal.name

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """As `Proposal.propose`, but of as few samples as there is time for: (≤ n, 3)."""
        self._begun_ns = start = self.clock()
        left = np.inf if self.deadline_ns is None else self.deadline_ns - start
        self.level = next(k for k in range(len(self.rungs)) if self._fits(k, n, left))
        rung = self.rungs[self.level]
        self.counters.proposals += 1
        self.counters.degraded += self.level > 0
        self._asked = max(round(rung.share * n), 1) if rung.proposal is not None else 0
        if rung.proposal is None:
            self.counters.skipped += 1
            return np.empty((0, 3))
        poses = rung.proposal.propose(z, live, self._asked, rng)
        took = self.clock() - start
        self.spent_ns += took
        self.name = rung.proposal.name
        rung.cost_ns += GAIN * (took - rung.cost_ns)
        return poses

    def used(self) -> None:
        """The filter is done with the samples of the last call: learn what it takes for them."""
        if self._asked:
            each = (self.clock() - self._begun_ns - self.rungs[self.level].cost_ns) / (
                OVERHEAD + self._asked
            )
            self.filter_ns += GAIN * (max(each, 0.0) - self.filter_ns)
        self._asked = 0

    def _fits(self, k: int, n: int, left_ns: float) -> bool:
        """Whether the time left carries a rung: the last one always."""
        rung = self.rungs[k]
        if rung.proposal is None:
            return True
        after = self.filter_ns * (OVERHEAD + rung.share * n)
        in_budget = k > 0 or rung.cost_ns <= self.budget_ns or np.isinf(left_ns)
        return in_budget and MARGIN * (rung.cost_ns + after) <= left_ns


def rungs(chosen: Sequence[tuple[Proposal, float]]) -> list[Rung]:
    """The ladder of proposals with their cost [ns] in order of preference: of those after the
    first only what is cheaper than all before; then fewer samples of the cheapest; then none."""
    made: list[Rung] = []
    for proposal, cost_ns in chosen:
        if not made or cost_ns < made[-1].cost_ns:
            made.append(Rung(proposal, 1.0, cost_ns))
    last = made[-1]
    made += [Rung(last.proposal, share, last.cost_ns) for share in SHARES]
    return [*made, Rung(None)]
