"""The samplers in use: the time that they take, and half the samples where touches are late.

After several touches in a row that take longer than they have, half the samples are drawn, until
`begin_anew`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import ANALYTIC, Table

PATIENCE = 3  # touches in a row that may take too long

ClockNs = Callable[[], int]


class Degraded(IntEnum):
    """How many of the wanted samples are drawn."""

    ALL = 0
    HALF = 1


class Samples:
    """The proposal of each object, and what all of them share."""

    def __init__(self, proposals: Sequence[Proposal] = (), clock: ClockNs | None = None) -> None:
        """`clock` measures the time in proposals [ns]; without one they take none."""
        self.proposals = list(proposals)
        self.clock: ClockNs = clock or (lambda: 0)
        self.spent_ns = 0  # time in proposals, since start
        self.begin_anew()

    def begin_anew(self) -> None:
        """Draw all samples again."""
        self.degraded, self._late = Degraded.ALL, 0

    @property
    def name(self) -> str:
        """The first object's proposal."""
        return self.proposals[0].name

    def of(self, k: int) -> Proposal:
        """The samples of the k-th object."""
        return _Measured(self, self.proposals[k])

    def beside(self, model: ObservationModel) -> list[Proposal]:
        """Samples of contacts on the further links of a model. Samplers are of the first link, so
        the others have the table, or the analytic proposal that was chosen."""
        kind = ANALYTIC.get(self.name, Table)
        return [_Measured(self, kind(each)) for each in model.links[1:]]

    def took(self, ns: float, limit_ns: float) -> bool:
        """A touch that brought samples took `ns` of the `limit_ns` that it has; → whether fewer
        samples are drawn from now on."""
        self._late = self._late + 1 if ns > limit_ns else 0
        if self._late < PATIENCE or self.degraded:
            return False
        self.degraded = Degraded.HALF
        return True


@dataclass(frozen=True, slots=True)
class _Measured:
    """A proposal whose time is counted."""

    samples: Samples
    proposal: Proposal

    @property
    def name(self) -> str:
        return self.proposal.name

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """z (M,), live (M,) → object poses (≤ n, 3) in the sensor frame."""
        samples = self.samples
        wanted = max(n // 2 if samples.degraded else n, 1)
        start = samples.clock()
        poses = self.proposal.propose(z, live, wanted, rng)
        samples.spent_ns += samples.clock() - start
        return poses
