"""One update of the filter beside two published ones: the same likelihood, scans and sizes.

`make bench-peers` gives it an environment of its own, as `particles` needs an older numpy. Each
filter takes one scan of 80 taxels without samples: likelihood, resampling, and a random step of
each particle. A belief that remembers does more: it accepts a step by the likelihood of all
remembered touches (Metropolis). CPU time, medians over interleaved rounds.
"""

import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from particles import distributions
from particles.core import SMC
from particles.state_space_models import Bootstrap, StateSpaceModel
from pfilter import ParticleFilter

from taxeld.config.tables import FilterConfig, SensorPoseConfig, SkinConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.memory import Memory, ObjectSkin
from taxeld.estimator.object_belief import ObjectBelief
from taxeld.estimator.paper import Paper
from taxeld.estimator.scans import Reader
from taxeld.layout import read as layouts
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.proposals import manifest

SIZES = {100: (20, 20, 0.3), 1000: (20, 4, 2.0), 10_000: (8, 1, 20.0)}
"""Particles: rounds, steps of each, budget [ms]."""
SCENE = Path(str(importlib.util.find_spec("taxeld").submodule_search_locations[0]))  # type: ignore[union-attr, index]
PRIOR_SD = np.array([0.01, 0.01, 0.1])
SCANS, TOUCHES = 40, 8  # readings; touches that are remembered


class PeerScans:
    """Readings of touches with the object at the origin, one after the other."""

    def __init__(self, model: ObservationModel) -> None:
        rng = np.random.default_rng(0)
        self.model, self.noise = model, Noise()
        self.nothing = Memory(ObjectSkin.of(model, self.noise))
        self.reader = Reader(model.links, self.noise)
        made = contacts.synthesise(model.scene, 0.04, 0.005, 4 * SCANS, rng).pose
        made = made[model.activation(made).max(axis=1) > 0.1][:SCANS]
        live = np.ones(len(model.layout), dtype=np.bool_)
        self.observations = [
            Observation(se2.inverse(p), self.noise.draw(model.activation(p[None])[0], rng), live)
            for p in made
        ]

    def log_likelihood(self, k: int, poses: np.ndarray) -> np.ndarray:
        """Log likelihood (N,) of poses (N, 3) for scan `k`, as for a new scan."""
        memory = self.nothing.plus(self.reader.read(self.observations[k % SCANS]))
        return memory.explain(poses).scans[:, 0]

    def belief(self, n: int, kind: type[ObjectBelief]) -> ObjectBelief:
        """A belief with N particles and no samples; but for the paper's it remembers eight
        touches."""
        config = FilterConfig(particles=n, particles_max=n)
        start = np.random.default_rng(1).standard_normal((n, 3)) * PRIOR_SD
        sigma_m, rng = SensorPoseConfig().sigma_m, np.random.default_rng(2)
        belief = kind(self.model, config, sigma_m, rng, lambda *_: np.empty((0, 3)))
        belief.particles = pf.equal(start.copy())
        if kind is ObjectBelief:
            for number, observation in enumerate(self.observations[:TOUCHES], 1):
                belief.memory = belief.memory.plus(self.reader.read(observation, number))
            belief.particles.explained = belief.memory.explain(start)
        return belief


class PeerModel(StateSpaceModel):
    """The model of the package `particles`."""

    scans: PeerScans

    def PX0(self) -> object:  # noqa: N802
        return distributions.IndepProd(*(distributions.Normal(scale=s) for s in PRIOR_SD))

    def PX(self, t: int, xp: np.ndarray) -> object:  # noqa: N802, ARG002
        return distributions.IndepProd(
            *(distributions.Normal(loc=xp[:, i], scale=0.1 * s) for i, s in enumerate(PRIOR_SD))
        )

    def PY(self, t: int, xp: object, x: np.ndarray) -> object:  # noqa: N802, ARG002
        return PeerLikelihood(self.scans, t, x)


class PeerLikelihood(distributions.ProbDist):  # type: ignore[misc]
    """Of poses, by a scan."""

    dim = 1

    def __init__(self, scans: PeerScans, k: int, poses: np.ndarray) -> None:
        self._scans, self._k, self._poses = scans, k, poses

    def logpdf(self, _: object) -> np.ndarray:
        return self._scans.log_likelihood(self._k, self._poses)


def measure(scans: PeerScans, n: int) -> dict[str, float]:
    """Milliseconds of a step, by filter. The clock is slow to read, so several are timed at
    once."""
    rounds, steps, _ = SIZES[n]
    PeerModel.scans = scans
    data = [None] * (rounds * steps + 1)
    smc = SMC(fk=Bootstrap(ssm=PeerModel(), data=data), N=n, resampling="systematic")
    at, rng = [0], np.random.default_rng(2)

    def weigh(poses: np.ndarray, _: object) -> np.ndarray:
        told = scans.log_likelihood(at[0], poses)
        return np.exp(told - told.max())  # it works with plain likelihoods

    peer = ParticleFilter(
        prior_fn=lambda count: np.random.default_rng(1).standard_normal((count, 3)) * PRIOR_SD,
        n_particles=n,
        observe_fn=lambda poses: poses,
        weight_fn=weigh,
        noise_fn=lambda poses: poses + rng.standard_normal(poses.shape) * 0.1 * PRIOR_SD,
        n_eff_threshold=0.5,
    )
    spent: dict[str, list[float]] = {}

    def timed(name: str, each: list[Any], step: Callable[[Any], object]) -> None:
        begin = time.thread_time_ns()
        for item in each:
            step(item)
        took_ms = (time.thread_time_ns() - begin) / 1e6 / len(each)
        spent.setdefault(name, []).append(took_ms)

    for k in range(rounds):
        at[0], seen = k, scans.observations[k % SCANS]
        for name, kind in (("taxeld", Paper), ("taxeld, 8 touches remembered", ObjectBelief)):
            fresh = [scans.belief(n, kind) for _ in range(steps)]
            timed(name, fresh, lambda belief: belief.take(scans.reader.read(seen, TOUCHES + 1)))  # noqa: B023
        timed("particles", [smc] * steps, next)
        timed("pfilter", [peer] * steps, lambda one: one.update(np.zeros(3)))
    return {name: float(np.median(each[1:])) for name, each in spent.items()}


def main() -> None:
    skin = layouts.load(SkinConfig().layout)
    box = manifest.parse_scene((SCENE / "bundles" / "box" / "scene.npz").read_bytes(), SCENE)
    scans = PeerScans(ObservationModel(box, skin, SkinConfig().full_scale_depth_m))
    print(f"{'filter':34s} {'N':>7s} {'ms':>9s} {'budget':>8s} {'ours is':>10s}")
    for n, (_, _, budget_ms) in SIZES.items():
        found = measure(scans, n)
        for name, ms in found.items():
            budget = f"{budget_ms:8.1f}" if name == "taxeld" else " " * 8
            print(f"{name:34s} {n:7d} {ms:9.3f} {budget} {ms / found['taxeld']:8.1f} ×", flush=True)


if __name__ == "__main__":
    main()
