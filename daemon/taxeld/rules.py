"""The two rules by which a belief learns from a scan and the samples that a touch brings.

`Paper` is Algorithm 1 of Marić et al. 2025, kept as the baseline. `Mixture` remembers scans, has
the samples stand beside the belief by their evidence, and drops the past when the object has moved.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taxeld import filter as pf
from taxeld import injection
from taxeld.config import FilterConfig
from taxeld.estimate import summarise
from taxeld.filter import Belief
from taxeld.memory import Felt, Memory
from taxeld.observation import Noise, ObservationModel
from taxeld.prior import Prior
from taxeld.push import push
from taxeld.se2 import Poses
from taxeld.symmetry import PoseMetric

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MOVES = 2  # Metropolis steps a touch
SILENT_MAX = 32  # scans remembered in which nothing was felt
TELLING = 1.0  # nats by which a silence must part the particles to be remembered
LACK_MAX, LACK_TAXEL = 10.0, 1.0  # nats a scan, and each taxel that felt, may lack of being
# explained as well as any could be: what the true pose lacks in 1 of 1000 touches
PUSHED_M = 2e-4  # between two scans: less than this is a press that settles
USUAL_LACK, USUAL_TAXEL = 2.0, 0.55  # nats that a touch, and each of its taxels, usually lack
USUAL_SPREAD = 3.5  # of the sum over touches, times the root of its taxels: 3.1 at most in 120 seen
SURE = 4  # touches that must agree once any was refuted
SETTLED_SHARE = 0.5  # of S, by the paper's rule when settled: a wrong belief must find out


@dataclass(slots=True)
class RuleCounters:
    """Since start."""

    impossible: int = 0  # scans under which every pose was impossible: the belief began anew
    inconsistent: int = 0  # scans that no pose explained
    forgotten: int = 0  # times that the past was dropped: the object had moved


class Rule(Protocol):
    """A belief, and how it learns."""

    belief: Belief
    doubt: bool  # whether no pose explains the newest scan, or all together
    counters: RuleCounters

    @property
    def sure(self) -> bool:
        """Whether enough scans agree for a narrow belief to be trusted."""
        ...

    def follow(self, before: Felt, after: Felt) -> bool:
        """Move the belief as the object does that is pushed from one scan to the next; → whether
        it was."""
        ...

    def wanted(self, settled: float) -> int:
        """How many samples the next touch should bring, given the heaviest mode's weight."""
        ...

    def learn(self, felt: Felt, samples: Poses) -> float:
        """Take a scan, and poses (S, 3) in the world that explain it by themselves (none for a
        silent one); → log evidence."""
        ...


class Paper:
    """Algorithm 1: samples take the mean weight, and nothing is remembered but the newest scan."""

    def __init__(self, model: ObservationModel, config: FilterConfig, rng: np.random.Generator):
        self._model, self._config, self._rng = model, config, rng
        self._metric = PoseMetric(model.scene)
        self._noise = _noise(config)
        self.belief = _anew(config, rng)
        self.doubt, self.sure = False, True
        self.counters = RuleCounters()

    def follow(self, before: Felt, after: Felt) -> bool:
        self.belief.pose, pushed = push(
            self._model, self._metric, self.belief.pose, before.sensor, after.sensor,
            float(after.z.max()) * self._model.depth_max_m, self._rng,
        )  # fmt: skip
        return bool(self.belief.weight @ pushed >= PUSHED_M)

    def wanted(self, settled: float) -> int:
        """S falls as the belief settles on one mode."""
        share = max(1.0 - settled, SETTLED_SHARE)
        return min(round(share * self._config.injected), len(self.belief))

    def learn(self, felt: Felt, samples: Poses) -> float:
        injection.paper(self.belief, samples)
        memory = Memory(self._model, self._noise)
        memory.add(felt)
        explained = memory.explain(self.belief.pose)
        evidence = pf.reweight(self.belief, explained[:, 0])
        if evidence is None:
            self.counters.impossible += 1
            self.belief = _anew(self._config, self._rng)
            if len(samples):
                drawn = pf.equal(samples, np.empty((len(samples), 0)))
                self.belief = pf.resample(drawn, len(self.belief), self._rng)
            return 0.0
        self.doubt = bool(_lack(memory, self.belief.weight, explained)[0] > 0.0)
        self.counters.inconsistent += self.doubt
        if pf.resampling_is_due(self.belief):
            self.belief = pf.resample(self.belief, len(self.belief), self._rng)
            pf.roughen(self.belief, self._rng)
        return evidence


class Mixture:
    """Every remembered scan counts, and samples are weighed against all of them."""

    def __init__(self, model: ObservationModel, config: FilterConfig, rng: np.random.Generator):
        self._model, self._config, self._rng = model, config, rng
        self._metric = PoseMetric(model.scene)
        self._noise = _noise(config)
        self.memory = Memory(model, self._noise)
        self.belief = _anew(config, rng)
        self.doubt = False
        self.counters = RuleCounters()
        self._doubted = 0  # touches running that no pose explained
        self._refuted = False  # whether a touch ever was

    @property
    def sure(self) -> bool:
        """Where touches have contradicted each other, a few that do not may do so by chance."""
        return not self._refuted or bool(np.count_nonzero(self.memory.touch) >= SURE)

    def follow(self, before: Felt, after: Felt) -> bool:
        """What is remembered was felt where the object no longer is: a prior stands for it."""
        belief = self.belief
        pose, pushed = push(
            self._model, self._metric, belief.pose, before.sensor, after.sensor,
            float(after.z.max()) * self._model.depth_max_m, self._rng,
        )  # fmt: skip
        if belief.weight @ pushed < PUSHED_M:
            return False
        belief.pose = pose
        modes = summarise(belief, self._metric).modes
        prior = Prior(self._metric, pose, belief.weight, modes)
        self.memory = Memory(self._model, self._noise, prior)
        belief.remembered = self.memory.explain(pose)
        return True

    def wanted(self, settled: float) -> int:  # noqa: ARG002  # a wide belief has more particles
        """S as configured, and more as the belief is wider or in doubt."""
        config = self._config
        size = config.particles_max if self._doubted else len(self.belief)
        return round(config.injected * max(size / config.particles, 1.0))

    def learn(self, felt: Felt, samples: Poses) -> float:
        belief, memory = self.belief, self.memory
        memory.add(felt)
        explained = memory.explain(belief.pose, since=len(memory) - 1)
        evidence = pf.reweight(belief, explained[:, 0])
        if evidence is None:
            self.counters.impossible += 1
            self._begin_anew(felt, samples)
            return 0.0
        belief.remembered = np.hstack([belief.remembered, explained])
        self.doubt = bool(_lack(memory, belief.weight, belief.remembered)[-1] > 0.0)
        if not felt.touch and np.ptp(explained) < TELLING:
            self._remember_only(np.arange(len(memory)) < len(memory) - 1)
        self._keep_to_size()
        if len(samples):
            self._take(samples)
            self._reconsider(samples)
        elif pf.resampling_is_due(belief):
            self._become(belief, moves=1)
        self.counters.inconsistent += self.doubt
        return evidence

    def _begin_anew(self, felt: Felt, samples: Poses) -> None:
        """From the samples of a touch, or from nothing."""
        self.memory = Memory(self._model, self._noise)
        self.belief = _anew(self._config, self._rng)
        if len(samples):
            self.memory.add(felt)
            self._become(pf.equal(samples, self.memory.explain(samples)), moves=MOVES)

    def _take(self, samples: Poses) -> None:
        """The samples' own opinion of all that is remembered, beside the belief's."""
        opinion = self._opinion(samples, self.memory)
        if np.count_nonzero(~self.memory.silent) > 1:  # the first touch: nothing to stand beside
            opinion = injection.merge(self.belief, opinion)
        self._become(opinion, moves=MOVES)

    def _opinion(self, samples: Poses, memory: Memory) -> Belief:
        """Samples of the newest scan brought to explain a whole memory."""
        own = (np.arange(len(memory)) == len(memory) - 1).astype(np.float64)
        opinion = pf.equal(samples, memory.explain(samples))
        return injection.anneal(opinion, own, memory.explain, self._rng)

    def _become(self, belief: Belief, moves: int) -> None:
        """Have as many particles as so wide a belief needs, all equal, and part the copies."""
        self.belief = pf.resample(belief, self._size(belief), self._rng)
        share = np.ones(len(self.memory))
        for _ in range(moves):
            pf.rejuvenate(self.belief, self.memory.explain, share, self._rng)

    def _size(self, belief: Belief) -> int:
        config = self._config
        if config.particles_max <= config.particles:
            return config.particles
        drawn = pf.resample(belief, config.particles, self._rng)
        wanted = pf.enough(pf.occupied(drawn.pose), config.kld_error, config.kld_confidence)
        return min(max(wanted, config.particles), config.particles_max)

    def _reconsider(self, samples: Poses) -> None:
        """After a touch: drop the past that it has refuted.

        One touch that nothing explains may be a fault. Two running that some pose explains, if only
        the past were not, tell that the object has moved.
        """
        lack = _lack(self.memory, self.belief.weight, self.belief.remembered)
        if lack[-1] <= 0.0:
            self._refuted |= bool((lack > 0.0).any())
            self._remember_only(lack <= 0.0)
        self.doubt = bool(lack[-1] > 0.0) or _is_too_much(self.memory, self.belief)
        if not self.doubt:
            self._doubted = 0
            return
        self._doubted += 1
        touches = np.flatnonzero(self.memory.touch)
        for last in dict.fromkeys((self._doubted, 2)):  # all since the doubt began, or the last two
            if 2 <= last <= min(self._doubted, len(touches)) and self._begin_with(
                self.memory.only(np.arange(len(self.memory)) >= touches[-last]), samples
            ):
                return

    def _begin_with(self, recent: Memory, samples: Poses) -> bool:
        """Whether some pose explains all that is recent; if so, nothing else is remembered."""
        opinion = self._opinion(samples, recent)
        lack = _lack(recent, opinion.weight, opinion.remembered)
        if lack.max() > 0.0 or _is_too_much(recent, opinion):
            return False
        self.counters.forgotten += 1
        self._refuted = True
        self.memory = recent
        self._become(opinion, moves=MOVES)
        self.doubt, self._doubted = False, 0
        return True

    def _keep_to_size(self) -> None:
        kept = np.ones(len(self.memory), dtype=np.bool_)
        memory = self.memory
        for kind, most in ((memory.touch, self._config.memory), (memory.silent, SILENT_MAX)):
            mine = np.flatnonzero(kind)
            kept[mine[: max(len(mine) - most, 0)]] = False
        self._remember_only(kept)

    def _remember_only(self, kept: Bools) -> None:
        if not kept.all():
            self.memory = self.memory.only(kept)
            self.belief.remembered = self.belief.remembered[:, kept]


RULES: dict[str, type[Paper] | type[Mixture]] = {"paper": Paper, "mixture": Mixture}


def _lack(memory: Memory, weight: Floats, remembered: Floats) -> Floats:
    """(K,) nats by which each remembered scan is explained worse than is allowed."""
    allowed = LACK_MAX + LACK_TAXEL * memory.felt
    return np.asarray(memory.ceiling - allowed - weight @ remembered)


def _is_too_much(memory: Memory, belief: Belief) -> bool:
    """Whether the remembered touches together are explained worse than is allowed, though each
    alone may pass: a wrong object of about the right shape."""
    touch = memory.touch
    touches, felt = int(np.count_nonzero(touch)), float(memory.felt[touch].sum())
    lack = float((memory.ceiling - belief.weight @ belief.remembered)[touch].sum())
    usual = USUAL_LACK * touches + USUAL_TAXEL * felt
    return touches > 1 and lack > usual + USUAL_SPREAD * math.sqrt(felt)


def _noise(config: FilterConfig) -> Noise:
    return Noise(config.noise_sigma, config.gain_cv, config.outliers)


def _anew(config: FilterConfig, rng: np.random.Generator) -> Belief:
    """A uniform belief that remembers nothing."""
    return pf.uniform(config.particles, config.centre_m, config.half_width_m, rng)
