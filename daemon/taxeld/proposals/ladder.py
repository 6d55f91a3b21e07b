"""A proposal that may have to save: the chosen sampler, cheaper ones, fewer samples, the table.

The first rung serves as long as touches fit into their time. Where several in a row do not, the
ladder steps down by one rung, and stays there until `begin_anew`. `degraded` in messages is the
step of the rung in use.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.observation import ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.proposals.analytic import ANALYTIC, Table

PATIENCE = 3  # touches in a row that may take too long

ClockNs = Callable[[], int]


def no_clock() -> int:
    return 0


class Step(IntEnum):
    """How far down the ladder a call went."""

    CHOSEN = 0
    CHEAPER = 1  # another, cheaper sampler
    FEWER = 2  # fewer samples of the cheapest sampler
    TABLE = 3


@dataclass(frozen=True, slots=True)
class Rung:
    """A proposal, and its share of the wanted samples."""

    step: Step
    proposal: Proposal
    share: float = 1.0
    more: Sequence[Proposal] = ()  # of further objects

    def of(self, k: int) -> Proposal:
        """The proposal of the k-th object."""
        return self.more[k - 1] if k else self.proposal


class Ladder:
    """A proposal that steps down where touches do not fit into their time."""

    def __init__(self, rungs: list[Rung], clock: ClockNs = no_clock) -> None:
        """`rungs`: from the chosen one down, none without an object; `clock` measures the time in
        proposals [ns]."""
        self.rungs = rungs
        self.clock = clock
        self.spent_ns = 0  # time in proposals, since start
        self.first = 0  # rung at which it begins
        self.begin_anew()

    def begin_anew(self) -> None:
        """Go back to the rung that fitted at start."""
        self._at, self._late = self.first, 0

    @property
    def rung(self) -> Rung:
        """The rung in use."""
        return self.rungs[self._at]

    @property
    def step(self) -> Step:
        """How far down it is."""
        return self.rung.step if self.rungs else Step.CHOSEN

    @property
    def name(self) -> str:
        """The proposal in use."""
        return self.rung.proposal.name

    @property
    def is_lowest(self) -> bool:
        return self._at == len(self.rungs) - 1

    def of(self, k: int) -> Proposal:
        """The samples of the k-th object: all objects are on one rung."""
        return OnLadder(self, lambda rung: rung.of(k)) if k else self

    def beside(self, model: ObservationModel) -> list[Proposal]:
        """Samples of contacts on the further links of a model. Samplers are of the first link, so
        the others have the table, or the analytic proposal that was chosen."""
        kind = ANALYTIC.get(self.rungs[0].proposal.name, Table)
        return [OnLadder(self, _always(kind(each))) for each in model.links[1:]]

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """Like `Proposal.propose` of the first object: z (M,), live (M,) → (≤ n, 3)."""
        return self.drawn(self.rung.proposal, z, live, n, rng)

    def drawn(
        self, proposal: Proposal, z: Floats, live: Bools, n: int, rng: np.random.Generator
    ) -> Poses:
        """Samples (≤ n, 3) of any proposal, with the share of them that the rung has; their time is
        counted."""
        start = self.clock()
        poses = proposal.propose(z, live, max(round(self.rung.share * n), 1), rng)
        self.spent_ns += self.clock() - start
        return poses

    def took(self, ns: float, limit_ns: float) -> bool:
        """A touch that brought samples took `ns` of the `limit_ns` that it has; → whether the
        ladder has stepped down for it."""
        self._late = self._late + 1 if ns > limit_ns else 0
        if self._late < PATIENCE or self.is_lowest:
            return False
        self.step_down()
        return True

    def step_down(self) -> None:
        """Use the next rung from now on."""
        self._at, self._late = min(self._at + 1, len(self.rungs) - 1), 0


@dataclass(frozen=True, slots=True)
class OnLadder:
    """A proposal that saves samples as a ladder does."""

    ladder: Ladder
    of: Callable[[Rung], Proposal]

    @property
    def name(self) -> str:
        return self.of(self.ladder.rung).name

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """z (M,), live (M,) → object poses (≤ n, 3) in the sensor frame."""
        return self.ladder.drawn(self.of(self.ladder.rung), z, live, n, rng)


def _always(proposal: Proposal) -> Callable[[Rung], Proposal]:
    return lambda _: proposal
