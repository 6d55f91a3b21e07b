"""Which proposals serve on this machine, by the CPU time of a call.

Only this module of the room measures time, and only the service asks it.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from taxeld.config.tables import Config, FilterConfig
from taxeld.model.observation import ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.proposals import several
from taxeld.proposals.analytic import Table
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.ladder import ClockNs, Ladder, Rung, Step

AUTO = "auto"
TIMED_CALLS = 5  # calls whose median is the cost of a proposal
SHARES = (0.5, 0.25)  # shares of the samples, if the cheapest sampler is too slow for all


Opened = dict[str, Proposal]  # proposals by name


def ladder(bundles: Sequence[Bundle], config: Config, clock: ClockNs) -> Ladder:
    """The configured proposal and its substitutes for when time is short; `clock` is in ns. What
    serves is found out with one bundle, and the others follow.

    Raises:
        SetupError: one of them cannot be used.
    """
    if not bundles:
        return Ladder([], clock)
    first = several.leading(bundles)
    opened = open_all(first, config.filter)
    chosen = choose(first, opened, config.filter, config.budget.propose_ms)
    made = rungs(first, opened, chosen, config.filter.injected)
    return Ladder(_for_all(made, first, opened, bundles), clock)


def _for_all(
    made: list[Rung], first: Bundle, opened: Opened, bundles: Sequence[Bundle]
) -> list[Rung]:
    """Rungs with the proposals of all bundles, each of which is opened once, where it is used;
    `made` and `opened` are of the bundle `first`."""
    names = {id(proposal): name for name, proposal in opened.items()}
    kept = [opened if one is first else Opened() for one in bundles]
    for_all = []
    for rung in made:
        name = names[id(rung.proposal)]
        for one, own in zip(bundles, kept, strict=True):
            if one.own(name) not in own:
                own[one.own(name)] = one.open(one.own(name))
        each = [own[one.own(name)] for one, own in zip(bundles, kept, strict=True)]
        for_all.append(replace(rung, proposal=each[0], more=each[1:]))
    return for_all


def open_all(bundle: Bundle, config: FilterConfig) -> Opened:
    """All proposals that a run may use, on any machine.

    Raises:
        SetupError: the bundle has none of the configured name, or one cannot be used.
    """
    chosen = bundle.resolve(config.proposal)
    names = bundle.choices if config.proposal == AUTO else [chosen, *bundle.cheaper(chosen)]
    return {name: bundle.open(name) for name in dict.fromkeys([*names, Table.name])}


def choose(bundle: Bundle, opened: Opened, config: FilterConfig, budget_ms: float) -> str:
    """The name of the configured proposal.

    `auto` is the first of the bundle's choices whose CPU time for the samples of a touch is at most
    `budget_ms`, or the cheapest where none is.
    """
    if config.proposal != AUTO:
        return bundle.resolve(config.proposal)
    timed: list[tuple[float, str]] = []
    for name in bundle.choices:
        ms = cpu_ms(opened[name], bundle.model, config.injected)
        if ms <= budget_ms:
            return name
        timed.append((ms, name))
    return min(timed)[1]


def rungs(bundle: Bundle, opened: Opened, chosen: str, samples: int) -> list[Rung]:
    """The chosen proposal, cheaper samplers by the bundle's preference, fewer samples of the last
    of them, and the table if it is cheaper still."""

    def ms(rung: Rung) -> float:
        return cpu_ms(rung.proposal, bundle.model, max(round(rung.share * samples), 1))

    made = [Rung(Step.CHOSEN, opened[chosen])]
    for name in bundle.cheaper(chosen):
        cheaper = Rung(Step.CHEAPER, opened[name])
        made += [cheaper] if ms(cheaper) < ms(made[-1]) else []
    made += [Rung(Step.FEWER, made[-1].proposal, share) for share in SHARES]
    table = Rung(Step.TABLE, opened[Table.name])
    if chosen != Table.name and ms(table) < ms(made[-1]):
        made.append(table)
    return made


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
