"""Which proposals serve on this machine, by the CPU time of a call, measured once at start.

Only this module of the room measures time, and only the service asks it to.
"""

import time
from collections.abc import Sequence

import numpy as np

from taxeld.config.tables import FilterConfig
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.samples import ClockNs, Samples

BUDGET_MS = 5.0  # CPU time for the samples of a touch
TIMED_CALLS = 5  # calls whose median is the cost of a proposal


def samples(
    bundles: Sequence[Bundle], config: FilterConfig, clock: ClockNs | None = None
) -> Samples:
    """The configured proposal of each object, chosen with the bundle that has the most of them; an
    object that has none of that name has the table.

    `clock` [ns] measures the time in proposals. Without one nothing is timed, and `auto` is the
    bundle's first: the same samples on any machine.

    Raises:
        SetupError: one of them cannot be used.
    """
    if not bundles:
        return Samples((), clock)
    leading, names = _leading(bundles), possible(bundles, config)
    name, chosen = choose(leading, names if clock else names[:1], config.injected)
    return Samples([chosen if one is leading else one.open(name) for one in bundles], clock)


def possible(bundles: Sequence[Bundle], config: FilterConfig) -> list[str]:
    """The names of all proposals that may be chosen, on any machine. Raises SetupError."""
    leading = _leading(bundles)
    return list(leading.order) if config.proposal == "auto" else [leading.resolve(config.proposal)]


def _leading(bundles: Sequence[Bundle]) -> Bundle:
    return max(bundles, key=lambda one: len(one.order))


def choose(
    bundle: Bundle, names: Sequence[str], samples: int, budget_ms: float = BUDGET_MS
) -> tuple[str, Proposal]:
    """The first named proposal whose CPU time for the `samples` of a touch is at most `budget_ms`,
    or the cheapest where none is; a single one is not timed."""
    costs: dict[str, float] = {}
    opened: dict[str, Proposal] = {}
    for name in names:
        opened[name] = bundle.open(name)
        costs[name] = cpu_ms(opened[name], bundle.model, samples) if len(names) > 1 else 0.0
        if costs[name] <= budget_ms:
            break
    cheapest = min(costs, key=costs.__getitem__)
    return cheapest, opened[cheapest]


def cpu_ms(proposal: Proposal, model: ObservationModel, samples: int) -> float:
    """Median CPU time of a call [ms], without the first call."""
    rng = np.random.default_rng(0)
    taxels = len(model.layout)
    z, live = np.eye(1, taxels)[0], np.ones(taxels, dtype=bool)
    spent = []
    for _ in range(TIMED_CALLS + 1):
        start = time.thread_time_ns()
        proposal.propose(z, live, samples, rng)
        spent.append((time.thread_time_ns() - start) / 1e6)
    return float(np.median(spent[1:]))
