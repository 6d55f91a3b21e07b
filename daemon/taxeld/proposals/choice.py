"""Which proposals serve on this machine, by the CPU time of a call, measured once at start.

Only this module of the room measures time, and only the service asks it.
"""

import time
from collections.abc import Sequence

import numpy as np

from taxeld.config.tables import Config, FilterConfig
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.proposals import several
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.samples import ClockNs, Samples

AUTO = "auto"
BUDGET_MS = 5.0  # CPU time for the samples of a touch
TIMED_CALLS = 5  # calls whose median is the cost of a proposal


def samples(bundles: Sequence[Bundle], config: Config, clock: ClockNs) -> Samples:
    """The configured proposal of each object, chosen with one bundle; `clock` is in ns.

    Raises:
        SetupError: one of them cannot be used.
    """
    if not bundles:
        return Samples(clock=clock)
    first = several.leading(bundles)
    name, chosen = choose(first, config.filter, BUDGET_MS)
    each = [chosen if one is first else one.open(one.own(name)) for one in bundles]
    return Samples(each, clock)


def possible(bundle: Bundle, config: FilterConfig) -> list[str]:
    """The names of all proposals that may be chosen, on any machine. Raises SetupError."""
    return bundle.choices if config.proposal == AUTO else [bundle.resolve(config.proposal)]


def choose(bundle: Bundle, config: FilterConfig, budget_ms: float) -> tuple[str, Proposal]:
    """The configured proposal, and its name.

    `auto` is the first of the bundle's choices whose CPU time for the samples of a touch is at most
    `budget_ms`, or the cheapest where none is.
    """
    # each is opened, so that a broken one is found on any machine
    opened, costs = {name: bundle.open(name) for name in possible(bundle, config)}, {}
    for name, proposal in opened.items():
        costs[name] = cpu_ms(proposal, bundle.model, config.injected)
        if costs[name] <= budget_ms:
            return name, proposal
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
