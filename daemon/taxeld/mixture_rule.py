"""The rule that remembers: samples stand beside the belief by their evidence, and the past is
dropped when the object has moved."""

import numpy as np
from numpy.typing import NDArray

from taxeld import consistency, injection
from taxeld import filter as pf
from taxeld.config import FilterConfig
from taxeld.estimate import summarise
from taxeld.filter import Belief
from taxeld.memory import Felt, Memory
from taxeld.observation import ObservationModel
from taxeld.prior import Prior
from taxeld.push import push
from taxeld.rule import PUSHED_M, RuleCounters, anew, noise_of
from taxeld.se2 import Poses
from taxeld.symmetry import PoseMetric

Bools = NDArray[np.bool_]

MOVES = 2  # Metropolis steps a touch
SILENT_MAX = 32  # scans remembered in which nothing was felt
TELLING = 1.0  # nats by which a silence must part the particles to be remembered
SURE = 4  # touches that must agree once any was refuted
SEARCHED = 100  # samples that must have left a narrow belief where it was
THOUGHTS = 4  # a touch: opinions of what is remembered, taken while nothing new is felt


class Mixture:
    """Every remembered scan counts, and samples are weighed against all of them."""

    def __init__(self, model: ObservationModel, config: FilterConfig, rng: np.random.Generator):
        self._model, self._config, self._rng = model, config, rng
        self._metric = PoseMetric(model.scene)
        self._noise = noise_of(config)
        self.memory = Memory(model, self._noise)
        self.belief = anew(config, rng)
        self.doubt = False
        self.counters = RuleCounters()
        self._doubted = 0  # touches running that no pose explained
        self._refuted = False  # whether a touch ever was
        self._agreed = 0  # samples that have left the belief where it was
        self._thoughts = 0  # taken since the last touch
        self._recalled = 0  # the scan that is being thought of

    @property
    def sure(self) -> bool:
        """Where touches have contradicted each other, a few that do not may do so by chance; where
        few samples were drawn, a better place may not have been seen."""
        agree = not self._refuted or bool(np.count_nonzero(self.memory.touch) >= SURE)
        return agree and self._agreed >= SEARCHED

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
        self.doubt = bool(consistency.lack(memory, belief.weight, belief.remembered)[-1] > 0.0)
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

    def recalled(self) -> Felt | None:
        touches = np.flatnonzero(self.memory.touch)
        enough = self._agreed >= SEARCHED and not self.doubt
        if len(touches) < 2 or self._thoughts >= THOUGHTS or enough:
            return None
        self._recalled = int(self._rng.choice(touches))
        return self.memory.scan(self._recalled)

    def think(self, samples: Poses) -> None:
        self._thoughts += 1
        opinion = self._opinion(samples, self.memory, self._recalled)
        self._become(injection.merge(self.belief, opinion), moves=1)
        lack = consistency.lack(self.memory, self.belief.weight, self.belief.remembered)
        newest = np.flatnonzero(self.memory.touch)[-1]
        self.doubt = bool(lack[newest] > 0.0) or consistency.is_too_much(self.memory, self.belief)

    def searched(self, samples: int, *, agreed: bool) -> None:
        self._agreed = self._agreed + samples if agreed else 0

    def _begin_anew(self, felt: Felt, samples: Poses) -> None:
        """From the samples of a touch, or from nothing."""
        self.memory = Memory(self._model, self._noise)
        self.belief = anew(self._config, self._rng)
        if len(samples):
            self.memory.add(felt)
            self._become(pf.equal(samples, self.memory.explain(samples)), moves=MOVES)

    def _take(self, samples: Poses) -> None:
        """The samples' own opinion of all that is remembered, beside the belief's."""
        self._thoughts = 0
        opinion = self._opinion(samples, self.memory, len(self.memory) - 1)
        if np.count_nonzero(~self.memory.silent) > 1:  # the first touch: nothing to stand beside
            opinion = injection.merge(self.belief, opinion)
        self._become(opinion, moves=MOVES)

    def _opinion(self, samples: Poses, memory: Memory, scan: int) -> Belief:
        """Samples of one of its scans brought to explain a whole memory."""
        own = (np.arange(len(memory)) == scan).astype(np.float64)
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
        lack = consistency.lack(self.memory, self.belief.weight, self.belief.remembered)
        if lack[-1] <= 0.0:
            self._refuted |= bool((lack > 0.0).any())
            self._remember_only(lack <= 0.0)
        self.doubt = bool(lack[-1] > 0.0) or consistency.is_too_much(self.memory, self.belief)
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
        opinion = self._opinion(samples, recent, len(recent) - 1)
        lack = consistency.lack(recent, opinion.weight, opinion.remembered)
        if lack.max() > 0.0 or consistency.is_too_much(recent, opinion):
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
