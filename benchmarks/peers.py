"""One update of the filter beside two published ones: the same likelihood, scans and sizes.

`make bench-peers` gives it an environment of its own, as `particles` needs an older numpy. Each
filter takes one scan of 80 taxels without samples: likelihood, resampling, and a random step of
each particle. The mixture does more: it accepts a step by the likelihood of all remembered touches
(Metropolis). CPU time, medians over interleaved rounds.
"""

import argparse
import importlib.util
import json
import time
from collections.abc import Callable, Sequence
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
from taxeld.estimator.mixture import Mixture
from taxeld.estimator.paper import Paper
from taxeld.estimator.scans import ScanList
from taxeld.layout import read as layouts
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.proposals import manifest

SIZES = {  # particles: rounds, steps of each, budget [ms]
    100: (20, 20, 0.3),
    1000: (20, 4, 2.0),
    10_000: (8, 1, 20.0),
}
SCENE = Path(str(importlib.util.find_spec("taxeld").submodule_search_locations[0]))  # type: ignore[union-attr, index]
PRIOR_SD = np.array([0.01, 0.01, 0.1])
TOUCHES = 8  # remembered


class PeerScans:
    """Readings of touches with the object at the origin, one after the other."""

    def __init__(self, model: ObservationModel, count: int) -> None:
        rng = np.random.default_rng(0)
        self.model, self.noise = model, Noise()
        self.nothing = Memory(ObjectSkin.of(model, self.noise))
        self.list = ScanList(model.links, self.noise)
        made = contacts.synthesise(model.scene, 0.04, 0.005, 4 * count, rng).pose
        made = made[model.activation(made).max(axis=1) > 0.1][:count]
        live = np.ones(len(model.layout), dtype=np.bool_)
        self.observations = [
            Observation(se2.inverse(p), self.noise.draw(model.activation(p[None])[0], rng), live)
            for p in made
        ]

    def log_likelihood(self, k: int, poses: np.ndarray) -> np.ndarray:
        """Log likelihood (N,) of poses (N, 3) for scan `k`, as for a new scan."""
        memory = self.nothing.plus(self.list.add(self.observations[k % len(self.observations)]))
        return memory.explain(poses)[:, 0]


def ours(scans: PeerScans, n: int, kind: type[Mixture]) -> Callable[[], Mixture]:
    """Makes one of our rules with N particles and no samples; but for the paper's it remembers
    eight touches."""
    config = FilterConfig(particles=n, particles_max=n)
    start = np.random.default_rng(1).standard_normal((n, 3)) * PRIOR_SD

    def made() -> Mixture:
        robot_m = SensorPoseConfig().sigma_m
        nothing = np.empty((0, 3))
        rule = kind(scans.model, config, robot_m, np.random.default_rng(2), lambda *_: nothing)
        rule.belief = pf.equal(start.copy(), np.empty((n, 0)))
        if kind is Mixture:
            for number, observation in enumerate(scans.observations[:TOUCHES], 1):
                rule.memory = rule.memory.plus(scans.list.add(observation, number))
            rule.belief.remembered = rule.memory.explain(start)
        return rule

    return made


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
        return _Likelihood(self.scans, t, x)


class _Likelihood(distributions.ProbDist):  # type: ignore[misc]
    dim = 1

    def __init__(self, scans: PeerScans, k: int, poses: np.ndarray) -> None:
        self._scans, self._k, self._poses = scans, k, poses

    def logpdf(self, _y: object) -> np.ndarray:
        return self._scans.log_likelihood(self._k, self._poses)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="write the figures there as well")
    args = parser.parse_args()
    skin = layouts.load(SkinConfig().layout)
    box = manifest.parse_scene((SCENE / "bundles" / "box" / "scene.npz").read_bytes(), SCENE)
    scans = PeerScans(ObservationModel(box, skin, SkinConfig().full_scale_depth_m), 40)
    rows = [row for n in SIZES for row in measure(scans, n)]
    print(f"{'filter':34s} {'N':>7s} {'ms':>9s} {'budget':>8s} {'ours is':>10s}")
    for row in rows:
        budget = "" if row["budget_ms"] is None else f"{row['budget_ms']:8.1f}"
        print(
            f"{row['filter']:34s} {row['particles']:7d} {row['ms']:9.3f} {budget:>8s} "
            f"{row['ratio']:8.1f} ×"
        )
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


def measure(scans: PeerScans, n: int) -> list[dict[str, object]]:
    """One row a filter. The clock is slow to read, so small steps are timed several at once."""
    rounds, steps, budget = SIZES[n]
    PeerModel.scans = scans
    smc = SMC(
        fk=Bootstrap(ssm=PeerModel(), data=[None] * (rounds * steps + 1)),
        N=n,
        resampling="systematic",
        store_history=False,
    )
    at, rng = [0], np.random.default_rng(2)
    peer = ParticleFilter(
        prior_fn=lambda count: np.random.default_rng(1).standard_normal((count, 3)) * PRIOR_SD,
        n_particles=n,
        observe_fn=lambda poses: poses,
        weight_fn=lambda poses, _observed: _scaled(scans.log_likelihood(at[0], poses)),
        noise_fn=lambda poses: poses + rng.standard_normal(poses.shape) * 0.1 * PRIOR_SD,
        n_eff_threshold=0.5,
    )
    rules = {"taxeld": Paper, "taxeld, 8 touches remembered": Mixture}
    spent: dict[str, list[float]] = {name: [] for name in (*rules, "particles", "pfilter")}
    for k in range(rounds):
        at[0] = k
        observation = scans.observations[k % len(scans.observations)]
        for name, kind in rules.items():
            make = ours(scans, n, kind)
            fresh = [(make(), observation) for _ in range(steps)]
            spent[name].append(
                _ms(fresh, lambda item: item[0].take(scans.list.add(item[1], TOUCHES + 1)))
            )
        spent["particles"].append(_ms(range(steps), lambda _: next(smc)))
        spent["pfilter"].append(_ms(range(steps), lambda _: peer.update(np.zeros(3))))
    ms = {name: float(np.median(each[1:])) for name, each in spent.items()}
    return [
        {
            "filter": name,
            "particles": n,
            "ms": value,
            "budget_ms": budget if name == "taxeld" else None,
            "ratio": value / ms["taxeld"],
        }
        for name, value in ms.items()
    ]


def _ms(items: Sequence[Any], step: Callable[[Any], object]) -> float:
    """CPU milliseconds a step."""
    begin = time.thread_time_ns()
    for item in items:
        step(item)
    return (time.thread_time_ns() - begin) / 1e6 / len(items)


def _scaled(log_likelihood: np.ndarray) -> np.ndarray:
    """Weights for a filter that works with plain likelihoods, out of the reach of underflow."""
    return np.exp(log_likelihood - log_likelihood.max())


if __name__ == "__main__":
    raise SystemExit(main())
