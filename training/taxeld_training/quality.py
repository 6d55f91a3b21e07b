"""How far a sampler is from the exact posterior, measured the way that bundle.json states."""

from dataclasses import dataclass

import numpy as np

from taxeld.observation import Noise, ObservationModel
from taxeld.proposals import Proposal
from taxeld_training.dataset import Touches, simulate
from taxeld_training.posterior import ExactPosterior, energy_distance

SAMPLES = 100
BANK = 200_000
LIMIT_ESS = 50.0  # touches whose exact posterior rests on fewer stored contacts are left out


@dataclass(frozen=True)
class Reference:
    """Readings with exact draws, made once and used for every sampler."""

    z: list[np.ndarray]
    exact: list[np.ndarray]  # each (2 · SAMPLES, 3): one half to measure to, one for the floor
    length_m: float
    left_out: int

    @property
    def floor(self) -> float:
        """The distance between two sets of exact draws: no sampler can show less."""
        return float(np.mean([
            energy_distance(e[SAMPLES:], e[:SAMPLES], self.length_m) for e in self.exact
        ]))  # fmt: skip


def reference(
    model: ObservationModel, noise: Noise, readings: int, rng: np.random.Generator
) -> Reference:
    """Exact posteriors of `readings` simulated readings, all taxels live."""
    posterior = ExactPosterior(simulate(model, BANK, rng), model.layout, noise)
    touches: Touches = simulate(model, readings, rng)
    live = np.ones(len(model.layout), dtype=bool)
    kept_z, kept = [], []
    for h in touches.activation:
        z = noise.draw(h.astype(np.float64), rng)
        draws = posterior.sample(z, live, 2 * SAMPLES, rng)
        if draws.ess >= LIMIT_ESS:
            kept_z.append(z)
            kept.append(draws.pose)
    return Reference(kept_z, kept, model.scene.size, readings - len(kept))


def distance(proposal: Proposal, to: Reference, rng: np.random.Generator) -> float:
    """Mean energy distance of SAMPLES samples to the exact draws."""
    live = np.ones(len(to.z[0]), dtype=bool)
    return float(np.mean([
        energy_distance(proposal.propose(z, live, SAMPLES, rng), exact[:SAMPLES], to.length_m)
        for z, exact in zip(to.z, to.exact, strict=True)
    ]))  # fmt: skip
