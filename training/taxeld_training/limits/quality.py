"""A sampler's distance to the exact posterior, and its cost."""

import time
from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.contacts import Proposal
from taxeld.model.noise import Noise
from taxeld.model.observation import ObservationModel
from taxeld_training.limits.dense import Dense
from taxeld_training.limits.posterior import ExactPosterior, energy_distance
from taxeld_training.models.dataset import read, simulate

SAMPLES = 100
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

    @property
    def floor(self) -> float:
        """Mean energy distance of two sets of exact draws: zero but for chance."""
        found = [energy_distance(e[SAMPLES:], e[:SAMPLES], self.length_m) for e in self.exact]
        return float(np.mean(found))


def reference(
    model: ObservationModel,
    noise: Noise,
    readings: int,
    rng: np.random.Generator,
    bank: int = BANK,
) -> Reference:
    """Exact posteriors of a number of simulated readings, by `bank` contacts. Where they are too
    few for a reading, contacts are made around it."""
    exact = ExactPosterior(simulate(model, bank, rng), model.layout, noise)
    dense = Dense(model, noise, rng)
    kept: list[tuple[Floats, Bools, Poses, float]] = []
    for seen in read(model, noise, readings, rng):
        draws = exact.sample(seen, 2 * SAMPLES, rng)
        if draws.ess < THIN_ESS:
            draws = dense.sample(seen, 2 * SAMPLES, rng, exact)
        if draws.ess >= LIMIT_ESS:
            kept.append((seen.z, seen.live, draws.pose, draws.ess))
    z, live, exact_draws, ess = (np.array(each) for each in zip(*kept, strict=True))
    return Reference(z, live, exact_draws, ess, model.scene.size)


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
