"""The estimator: activations and sensor poses in, estimates out. No clock, no socket, no file.

It takes what can be used of a scan, picks the scans that tell something new (`news`), has the
belief learn from them by the configured rule (`rules`), and says what the result is worth.
"""

from dataclasses import dataclass, field

import numpy as np

from taxeld import injection, se2
from taxeld.config import FilterConfig
from taxeld.estimate import SEARCHING_WEIGHT, Estimate, ProposalKind, Status, Summary, summarise
from taxeld.filter import Belief
from taxeld.memory import Felt
from taxeld.news import News, moved_m
from taxeld.observation import ObservationModel
from taxeld.poses import JUMP_M
from taxeld.proposals import Proposal
from taxeld.rule import Rule, RuleCounters
from taxeld.rules import RULES
from taxeld.se2 import Poses
from taxeld.skin import Activation
from taxeld.stuck import Stuck
from taxeld.symmetry import PoseMetric

CONFIRMED_M = 0.02  # a heaviest mode within this of the touch before is the same


@dataclass(slots=True)
class EstimatorCounters:
    """Since start."""

    scans: int = 0
    updates: int = 0  # scans that told something new
    injections: int = 0
    thoughts: int = 0  # of them, while nothing new was felt
    bad_input: int = 0  # scans with values that are not finite
    out_of_range: int = 0  # scans with activations beyond 0..1, which were clipped
    back_in_time: int = 0  # scans older than the one before, not used
    jumps: int = 0  # scans whose sensor pose is too far from the last, not used
    stuck: int = 0  # scans in which a taxel read the same as ever, and was left out
    blind: int = 0  # scans without a live taxel, or none where the touch is expected
    rule: RuleCounters = field(default_factory=RuleCounters)


class Estimator:
    """A belief about one object, changed by one scan at a time; the same scans and seed give the
    same estimates, bit for bit."""

    def __init__(self, model: ObservationModel, proposal: Proposal, config: FilterConfig) -> None:
        self.model = model
        self.proposal = proposal
        self.config = config
        self.metric = PoseMetric(model.scene)
        self.counters = EstimatorCounters()
        self.reset()

    def reset(self) -> None:
        """Forget everything felt; the random generator begins anew as well."""
        self.rng = np.random.default_rng(self.config.seed)
        self.rule: Rule = RULES[self.config.injection](self.model, self.config, self.rng)
        self.rule.counters = self.counters.rule
        self._news = News(self.model.layout.radius_m)
        self._kind = ProposalKind.NONE
        self._t = -np.inf
        self._sensor: Poses | None = None
        self._before: Felt | None = None
        self._stuck = Stuck(len(self.model.layout))
        self._confirmed, self._touched = False, 0
        self._summary = summarise(self.rule.belief, self.metric)
        self.estimate = self._estimate(0.0, Status.SEARCHING)

    @property
    def belief(self) -> Belief:
        return self.rule.belief

    def on_scan(self, activation: Activation, sensor: Poses) -> Estimate:
        """Take what is felt at the sensor's pose (3,) in the world; never raises."""
        self.counters.scans += 1
        t = activation.t
        if not self._is_usable(activation, sensor):
            self.estimate = self._estimate(max(self.estimate.t, self._t), self._status())
            return self.estimate
        felt = self._felt(activation, sensor)
        self._t, self._sensor = t, sensor
        self._follow(felt)
        injected, log_evidence = 0, 0.0
        told = self._news.on_scan(t, felt) if felt.live.any() else None
        if told is not None:
            injected, log_evidence = self._learn(told)
        else:
            injected = self._think()
        status = self._status()
        if self._is_blind(felt):
            self.counters.blind += 1
            status = Status.BLIND
        self.estimate = self._estimate(t, status, injected, log_evidence)
        return self.estimate

    def _is_usable(self, activation: Activation, sensor: Poses) -> bool:
        """Whether to learn from a scan; what is wrong with it is counted."""
        counters, t, z = self.counters, activation.t, activation.z
        if not (np.isfinite(z).all() and np.isfinite(sensor).all() and np.isfinite(t)):
            counters.bad_input += 1
            return False
        if t < self._t:
            counters.back_in_time += 1
            return False
        if self._sensor is not None and moved_m(self._sensor, sensor, 0.0) > JUMP_M:
            counters.jumps += 1
            self._sensor = sensor  # where it stays, it is believed
            return False
        counters.out_of_range += bool(z.min() < 0.0 or z.max() > 1.0)
        return True

    def _felt(self, activation: Activation, sensor: Poses) -> Felt:
        """A scan as evidence: within its range, without taxels that are dead or stuck."""
        radius_m = self.model.layout.radius_m
        moved = 0.0 if self._sensor is None else moved_m(self._sensor, sensor, radius_m)
        z = np.clip(activation.z, 0.0, 1.0)
        stuck = self._stuck.on_scan(z, moved) & activation.live
        self.counters.stuck += bool(stuck.any())
        live = activation.live & ~stuck
        return Felt(sensor, np.where(live, z, 0.0), live)

    def _is_blind(self, felt: Felt) -> bool:
        """Whether no taxel lives, or none of those that the best pose presses."""
        if felt.live.all() or felt.touch:
            return False
        if not felt.live.any():
            return True
        seen = se2.compose(se2.inverse(felt.sensor), self._summary.modes[0].pose)
        pressed, _ = self.model.felt(seen[None])
        return self._news.contacts > 0 and len(pressed) > 0 and not felt.live[pressed].any()

    def _follow(self, felt: Felt) -> None:
        """Between two scans of one touch the object may have been pushed."""
        before, self._before = self._before, felt
        if self.config.motion == "none" or before is None or not (before.touch and felt.touch):
            return
        if self.rule.follow(before, felt):
            self._summary = summarise(self.rule.belief, self.metric)
            self._confirmed = False

    def _samples(self, felt: Felt) -> Poses:
        """Poses (S, 3) in the world that explain a touch by themselves; none for silence."""
        settled = self._summary.modes[0].weight if self._news.contacts > 1 else 0.0
        count = self.rule.wanted(settled) if felt.touch else 0
        if not count:
            return np.empty((0, 3))
        poses = self.proposal.propose(felt.z, felt.live, count, self.rng)
        poses = poses[np.isfinite(poses).all(axis=1)]
        if not len(poses):
            return poses
        if self.config.project:
            poses = injection.project(self.model, poses)
        self._kind = ProposalKind[self.proposal.name.upper()]
        self.counters.injections += 1
        return se2.compose(felt.sensor, poses)

    def _learn(self, felt: Felt) -> tuple[int, float]:
        """Take news; → how many samples it brought, and its log evidence."""
        self.counters.updates += 1
        samples = self._samples(felt)
        doubted = self.rule.doubt
        log_evidence = self.rule.learn(felt, samples)
        agreed = self._summarised(len(samples)) and not doubted
        if felt.touch and self._news.contacts != self._touched:  # one touch confirms nothing twice
            self._touched = self._news.contacts
            self._confirmed = agreed
        return len(samples), log_evidence

    def _think(self) -> int:
        """While nothing new is felt, look for what explains all touches better; → how many samples
        were drawn for that."""
        felt = self.rule.recalled()
        if felt is None:
            return 0
        samples = self._samples(felt)
        if not len(samples):  # none are asked for, or there is no time for any
            return 0
        self.counters.thoughts += 1
        self.rule.think(samples)
        self._confirmed &= self._summarised(len(samples))
        return len(samples)

    def _summarised(self, samples: int) -> bool:
        """Look at the belief; → whether a change of it, by so many samples, has left a narrow
        belief where it was."""
        before, self._summary = self._summary, summarise(self.rule.belief, self.metric)
        agreed = self._agrees(before, self._summary)
        self.rule.searched(samples, agreed=agreed)
        return agreed

    def _agrees(self, before: Summary, now: Summary) -> bool:
        """Whether a narrow belief has stayed where it was."""
        apart = self.metric.distance(before.modes[0].pose, now.modes[0].pose)
        return before.is_narrow and now.is_narrow and bool(apart < CONFIRMED_M)

    def _status(self) -> Status:
        summary = self._summary
        if not self._news.contacts:
            return Status.SEARCHING
        if self.rule.doubt:
            return Status.INCONSISTENT
        if summary.is_narrow and self._confirmed and self.rule.sure:
            return Status.CONVERGED
        weak = summary.modes[0].weight < SEARCHING_WEIGHT
        return Status.SEARCHING if weak else Status.AMBIGUOUS

    def _estimate(
        self, t: float, status: Status, injected: int = 0, log_evidence: float = 0.0
    ) -> Estimate:
        summary = self._summary
        return Estimate(
            t=t,
            status=status,
            contact=self._news.contact,
            contacts=self._news.contacts,
            map=summary.modes[0].pose,
            mean=summary.mean,
            cov=summary.cov,
            modes=summary.modes,
            ess=summary.ess,
            particles=summary.particles,
            injected=injected,
            proposal=self._kind,
            log_evidence=log_evidence,
        )
