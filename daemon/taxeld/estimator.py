"""The estimator: activations and sensor poses in, estimates out. No clock, no socket, no file.

A scan counts only where it tells something new, so that a held touch sharpens nothing:

- a press is judged once it stops deepening, when it says most;
- after that, and in free motion, again whenever the sensor has moved or the touch has changed by a
  unit of news; silence where the belief expects touch is evidence like any other.
"""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from taxeld import filter as pf
from taxeld import se2
from taxeld.config import FilterConfig
from taxeld.memory import Touches
from taxeld.observation import Noise, ObservationModel
from taxeld.proposals import Proposal
from taxeld.se2 import Poses
from taxeld.skin import Activation
from taxeld.symmetry import Mode, PoseMetric

NEWS_MOTION_M = 0.005  # a sensor that moved this far feels another place
NEWS_ACTIVATION = 0.5  # a taxel that changed this much feels another touch
RISING = 0.02  # a strongest activation that grew by more is a press still deepening
RELEASE_S = 0.15  # silence this long ends a contact: a flicker does not start another
MODE_RADIUS_M = 0.02  # of root-mean-square surface displacement
MODES_MAX = 5
MODE_CANDIDATES = 64
CONVERGED_WEIGHT = 0.8  # of the heaviest mode
CONVERGED_SD_M = 0.01
INJECTED_MIN_SHARE = 0.5  # of `injected`, kept when settled: a wrong belief must find out
MOVES = 2  # Metropolis steps a touch


class Status(IntEnum):
    """What the estimate is worth."""

    STARTING = 0  # the idle baseline is being learned
    SEARCHING = 1  # nothing touched yet, or too little
    AMBIGUOUS = 2  # several modes explain what was felt
    CONVERGED = 3  # one mode, narrow
    BLIND = 4  # no live taxel
    STALE = 5  # no fresh scan or sensor pose


class ProposalKind(IntEnum):
    """Which proposal served the last injection."""

    NONE = 0
    PROJECTION = 1
    DDPM = 2
    TABLE = 3
    MANIFOLD = 4
    DENSITY = 5


@dataclass(frozen=True, slots=True)
class Estimate:
    """The belief in short; poses of the object in the world."""

    t: float  # of the scan
    status: Status
    contact: bool
    contacts: int  # touches begun since reset
    map: Poses  # (3,) mean of the heaviest mode
    mean: Poses  # (3,)
    cov: Poses  # (3, 3) about the mean, turns up to symmetry
    modes: tuple[Mode, ...]
    ess: float
    particles: int
    injected: int  # by this scan
    proposal: ProposalKind
    log_evidence: float  # of this scan, 0 where it told nothing new


@dataclass(slots=True)
class EstimatorCounters:
    """Since start."""

    scans: int = 0
    updates: int = 0  # scans that told something new
    injections: int = 0
    impossible: int = 0  # updates under which every pose was impossible: the belief began anew
    bad_input: int = 0  # scans with values that are not finite
    blind: int = 0  # scans without a live taxel


@dataclass(slots=True)
class _News:
    """Where and what was felt when the belief last learned something."""

    sensor: Poses
    z: Poses
    strongest: float = 0.0  # of the scan before this one
    deepening: bool = False
    untold: bool = False  # a press that has begun and was not judged yet
    last_felt_s: float = field(default=-np.inf)


class Estimator:
    """A belief about one object, changed by one scan at a time; the same scans and seed give the
    same estimates, bit for bit."""

    def __init__(self, model: ObservationModel, proposal: Proposal, config: FilterConfig) -> None:
        self.model = model
        self.proposal = proposal
        self.config = config
        self.noise = Noise(config.noise_sigma, config.gain_cv, config.outliers)
        self.metric = PoseMetric(model.scene)
        self.counters = EstimatorCounters()
        self.reset()

    def reset(self) -> None:
        """Forget everything felt; the random generator begins anew as well."""
        self.rng = np.random.default_rng(self.config.seed)
        self._begin_anew()
        self._news = _News(np.full(3, np.inf), np.zeros(len(self.model.layout)))
        self._contact = False
        self._contacts = 0
        self._kind = ProposalKind.NONE
        self.estimate = self._summarise(0.0, Status.SEARCHING, 0, 0.0)

    def on_scan(self, activation: Activation, sensor: Poses) -> Estimate:
        """Take what is felt at the sensor's pose (3,) in the world; never raises."""
        self.counters.scans += 1
        finite = bool(np.isfinite(activation.z).all() and np.isfinite(sensor).all())
        if not finite or not activation.live.any():
            self.counters.bad_input += not finite
            self.counters.blind += finite
            self.estimate = self._summarise(activation.t, Status.BLIND, 0, 0.0)
            return self.estimate
        z = np.where(activation.live, activation.z, 0.0)
        told = self._is_news(activation.t, z, sensor)
        injected, log_evidence = 0, 0.0
        if told:
            self.counters.updates += 1
            self._news.sensor, self._news.z = sensor, z
            injected = self._inject(z, activation, sensor) if self._contact else 0
            log_evidence = self._learn(z, activation, sensor)
        self.estimate = self._summarise(activation.t, None, injected, log_evidence, fresh=told)
        return self.estimate

    def _is_news(self, t: float, z: Poses, sensor: Poses) -> bool:
        """Follow the touch, and say whether this scan is one to learn from."""
        news = self._news
        strongest = float(z.max())
        felt = strongest > 0.0
        if felt:
            news.last_felt_s = t
            if not self._contact:
                self._contacts += 1
                news.untold = True
            self._contact = True
        elif t - news.last_felt_s > RELEASE_S:
            self._contact = False
        rising = strongest > news.strongest + RISING
        news.strongest = strongest
        if felt and rising:
            return False
        if not felt and self._contact:  # just let go: neither a touch nor free yet
            return False
        if felt and news.untold:
            news.untold = False
            return True
        if not np.isfinite(news.sensor).all():
            return True
        gap = se2.compose(se2.inverse(news.sensor), sensor)
        moved = float(np.hypot(gap[0], gap[1]) + self.model.layout.radius_m * abs(gap[2]))
        changed = float(np.abs(z - news.z).max())
        return moved / NEWS_MOTION_M + changed / NEWS_ACTIVATION >= 1.0

    def _inject(self, z: Poses, activation: Activation, sensor: Poses) -> int:
        """Samples of the touch take the place of the least particles; S falls as the belief settles
        on one mode."""
        settled = self.estimate.modes[0].weight if self._contacts > 1 else 0.0
        share = max(1.0 - settled, INJECTED_MIN_SHARE)
        count = min(round(share * self.config.injected), len(self.belief))
        if count == 0:
            return 0
        poses = self.proposal.propose(z, activation.live, count, self.rng)
        poses = se2.compose(sensor, poses[np.isfinite(poses).all(axis=1)])
        pf.inject(self.belief, poses, self.memory.explain(poses))
        self._kind = ProposalKind[self.proposal.name.upper()]
        self.counters.injections += 1
        return len(poses)

    def _learn(self, z: Poses, activation: Activation, sensor: Poses) -> float:
        """Weigh the belief by a scan, and remember it if it is a touch; → log evidence."""
        belief = self.belief
        scan = Touches(self.model, self.noise)
        scan.add(sensor, z, activation.live)
        explained = scan.explain(belief.pose)
        evidence = pf.reweight(belief, explained[:, 0])
        if evidence is None:
            self.counters.impossible += 1
            self._begin_anew()
            return 0.0
        moves = 0
        size = self.config.memory
        if self._contact and size:
            self.memory.add(sensor, z, activation.live)
            self.memory.keep_last(size)
            belief.remembered = np.hstack([belief.remembered, explained])[:, -size:]
            moves = MOVES
        if pf.resampling_is_due(belief):
            pf.resample(belief, self.rng)
            moves = max(moves, 1)  # or the copies would stay one
        for _ in range(moves):
            pf.rejuvenate(belief, self.memory.explain, self.rng)
        return evidence

    def _begin_anew(self) -> None:
        """A uniform belief that remembers nothing."""
        config = self.config
        self.belief = pf.uniform(config.particles, config.centre_m, config.half_width_m, self.rng)
        self.memory = Touches(self.model, self.noise)

    def _summarise(
        self, t: float, status: Status | None, injected: int, log_evidence: float,
        *, fresh: bool = True,
    ) -> Estimate:  # fmt: skip
        """The belief in short; `fresh` where it changed since the last summary."""
        if fresh:
            belief = self.belief
            weight = belief.weight
            modes = tuple(
                self.metric.modes(belief.pose, weight, MODE_RADIUS_M, MODES_MAX, MODE_CANDIDATES)
            )
            best = modes[0].pose
            mean, cov = self.metric.mean(belief.pose, weight, best)
            ess = pf.effective_sample_size(belief)
        else:
            last = self.estimate
            modes, best, mean, cov, ess = last.modes, last.map, last.mean, last.cov, last.ess
        return Estimate(
            t=t,
            status=self._status(modes, cov) if status is None else status,
            contact=self._contact,
            contacts=self._contacts,
            map=best,
            mean=mean,
            cov=cov,
            modes=modes,
            ess=ess,
            particles=len(self.belief),
            injected=injected,
            proposal=self._kind,
            log_evidence=log_evidence,
        )

    def _status(self, modes: tuple[Mode, ...], cov: Poses) -> Status:
        if not self._contacts:
            return Status.SEARCHING
        sd = float(np.sqrt(cov[0, 0] + cov[1, 1] + self.metric.arm_m**2 * cov[2, 2]))
        if modes[0].weight >= CONVERGED_WEIGHT and sd < 2.0 * CONVERGED_SD_M:
            return Status.CONVERGED
        return Status.AMBIGUOUS if modes[0].weight >= 1.0 / MODES_MAX else Status.SEARCHING
