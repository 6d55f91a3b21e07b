"""A sampler's distance to the exact posterior and its cost, as bundle.json states them."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.contacts import Proposal
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld_hil import jobs
from taxeld_training.limits.dense import Dense
from taxeld_training.limits.posterior import Draws, ExactPosterior, energy_distance
from taxeld_training.models.dataset import read, simulate

SAMPLES = 100
BANK_STAGE, EXACT_STAGE = "contacts to measure with", "exact posteriors"
BANK = 300_000
THIN_ESS = 1000.0  # effective contacts of the bank, under which more are made around the reading
LIMIT_ESS = 50.0  # effective contacts; readings with fewer, for all that, are left out
TIMED_CALLS = 30


@dataclass(frozen=True)
class Reference:
    """Readings with draws of their exact posteriors, made once and used for every sampler."""

    z: Floats  # (n, M) readings as a filter sees them
    live: Bools  # (n, M) taxels that are not dead
    exact: Floats  # (n, 2 · SAMPLES, 3) draws: one half to measure to, one for the floor
    ess: Floats  # (n,) effective contacts behind the draws of each reading
    length_m: float
    left_out: int  # readings whose posteriors rest on too few contacts

    @property
    def floor(self) -> float:
        """Mean energy distance of two sets of exact draws: zero but for chance."""
        found = [energy_distance(e[SAMPLES:], e[:SAMPLES], self.length_m) for e in self.exact]
        return float(np.mean(found))

    @property
    def error(self) -> float:
        """Monte Carlo error of an expectation under the exact draws, in posterior standard
        deviations: the median over readings of 1/√ESS."""
        return float(np.median(1.0 / np.sqrt(self.ess)))


def reference(
    model: ObservationModel,
    noise: Noise,
    readings: int,
    rng: np.random.Generator,
    *,
    bank: int = BANK,
    workers: int = 1,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> Reference:
    """Exact posteriors of a number of simulated readings. Where the bank is too thin for one,
    contacts are made around it. Each reading has a random generator of its own, so any number of
    `workers` (processes) makes the same. `progress` is called with the stage and its share that is
    done."""
    contacts = simulate(model, bank, rng, partial(progress, BANK_STAGE))
    exact = ExactPosterior(contacts, model.layout, noise), Dense(model, noise, rng)
    drawn = read(model, noise, readings, rng)
    kept: list[tuple[Floats, Bools, Poses, float]] = []
    made = jobs.beside(_draws, exact, list(zip(drawn, rng.spawn(readings), strict=True)), workers)
    for done, (seen, draws) in enumerate(zip(drawn, made, strict=True)):
        progress(EXACT_STAGE, done / readings)
        if draws.ess >= LIMIT_ESS:
            kept.append((seen.z, seen.live, draws.pose, draws.ess))
    progress(EXACT_STAGE, 1.0)
    z, live, exact_draws, ess = (np.array(each) for each in zip(*kept, strict=True))
    return Reference(z, live, exact_draws, ess, model.scene.size, readings - len(kept))


def _draws(
    exact: tuple[ExactPosterior, Dense], of: tuple[Observation, np.random.Generator]
) -> Draws:
    """Draws for a reading: by the bank and, where that is too thin, by contacts made for it."""
    (bank, dense), (seen, rng) = exact, of
    draws = bank.sample(seen, 2 * SAMPLES, rng)
    return draws if draws.ess >= THIN_ESS else dense.sample(seen, 2 * SAMPLES, rng, bank)


def distances(proposal: Proposal, to: Reference, rng: np.random.Generator) -> Floats:
    """(readings,) energy distances of SAMPLES samples to the exact draws."""
    return np.array(
        [
            energy_distance(proposal.propose(z, live, SAMPLES, rng), exact[:SAMPLES], to.length_m)
            for z, live, exact in zip(to.z, to.live, to.exact, strict=True)
        ]
    )


def cost_ms(proposal: Proposal, to: Reference, rng: np.random.Generator) -> float:
    """Median CPU time [ms] of a call for SAMPLES samples on this thread, the first left out."""
    spent_ns = []
    for k in range(TIMED_CALLS + 1):
        i, start_ns = k % len(to.z), time.thread_time_ns()
        proposal.propose(to.z[i], to.live[i], SAMPLES, rng)
        spent_ns.append(time.thread_time_ns() - start_ns)
    return float(np.median(spent_ns[1:])) / 1e6
