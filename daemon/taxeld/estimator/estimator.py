"""The estimator: activations and sensor poses in, estimates out. No clock, no socket, no file.

It takes the usable part of a scan (`intake`), picks the scans to learn from (`news`), has the
belief learn from them by the configured rule (`rule`), which also says how sure it is (`verdict`).
docs/estimator.md is the model behind these.
"""

import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property, partial

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig, SensorPoseConfig
from taxeld.estimator.bank import Bank, Known
from taxeld.estimator.estimate import Estimate, ProposalKind, Status
from taxeld.estimator.history import VERSION, Arrays, History, Used, scan_arrays
from taxeld.estimator.intake import Intake
from taxeld.estimator.mixture import Mixture
from taxeld.estimator.news import ContactCount, News
from taxeld.estimator.paper import Paper
from taxeld.estimator.rule import EstimatorCounters, Rule
from taxeld.estimator.verdict import status
from taxeld.model.contacts import Proposal
from taxeld.model.observation import Activation, Lesson, Observation, ObservationModel
from taxeld.prior import PosePrior

RULES: dict[str, Callable[[ObservationModel, FilterConfig, float, np.random.Generator], Rule]] = {
    "paper": Paper,
    "mixture": Mixture,
}

LOST_S = 1.0  # a link that is heard no more for so long, while another is, touches nothing


class Estimator:
    """A belief about one object, changed by one scan at a time. The same scans and seed give the
    same bytes on one machine and one build."""

    def __init__(
        self,
        model: ObservationModel,
        proposal: Proposal,
        config: FilterConfig,
        robot_m: float = SensorPoseConfig().sigma_m,
        more: Sequence[Known] = (),
        beside: Sequence[Proposal] = (),
    ) -> None:
        """`robot_m`: standard deviation of the sensor's place at a touch, in each direction.
        `more`: further objects that it may be, on the same layouts. `beside`: samples of contacts
        on the model's further links."""
        self.robot_m = robot_m
        self.model = model  # of the first object
        self.known = [Known(model, proposal, beside), *more]
        self.config = config
        self.counters = EstimatorCounters()
        self.reset()

    def reset(self) -> None:
        """Forget every contact; the random generator begins anew as well."""
        config, links = self.config, self.model.links
        rng = np.random.default_rng(config.seed)
        begin = RULES[config.injection]
        self.bank = Bank(
            [begin(known.model, config, self.robot_m, rng) for known in self.known],
            [partial(self._draw, known) for known in self.known],
            first=max(range(len(self.known)), key=self._size_m),
        )
        self._rng = rng
        self._kind = ProposalKind.NONE  # proposal of the last samples
        self._intakes = [Intake(each, self.counters, k) for k, each in enumerate(links)]
        self._tally = ContactCount()
        self.history = History()
        self._news = [News(each.layout.radius_m, tally=self._tally) for each in links]
        self._before: list[Observation | None] = [None] * len(links)
        self._blind = False  # no live taxel would feel it, until a usable scan tells more
        # number of the last contact of which `taught` has told each link
        self._taught = [0] * len(links)
        self.used: Observation | None = None  # the scan that the last call learned from
        # the last scan, until `think`, if it told nothing
        self.unconsidered: Observation | None = None
        self.estimate = self._estimate(0.0)

    @property
    def memory(self) -> Arrays:
        """All that another estimator needs to learn the same: the scans, whose they are, and counts
        that differ once there is more."""
        return scan_arrays(self.history.scans) | {
            "digest": np.array(self.digest),
            "changes": np.array([self.history.changes, self.counters.updates]),
        }

    @cached_property
    def digest(self) -> str:
        """16 hex digits of all that scans and their use depend on: objects, layouts, and keys."""
        made = hashlib.sha256(repr((VERSION, self.config, self.robot_m)).encode())
        for known in self.known:
            for each in known.model.links:
                made.update(each.layout.digest.encode() + each.layout.uid.astype("<i8").tobytes())
                made.update(repr((each.depth_max_m, each.scene.symmetry)).encode())
                made.update(np.ascontiguousarray(each.scene.slices).tobytes())
                made.update(np.ascontiguousarray(each.scene.origin).tobytes())
        return made.hexdigest()[:16]

    @property
    def rule(self) -> Rule:
        """The belief about the likeliest object."""
        return self.bank.rule

    def on_scan(self, activation: Activation, sensor: Poses, link: int = 0) -> Estimate:
        """Take a scan's activations at the sensor's pose (3,) in the world, and think about it at
        once; never raises."""
        self.learn(activation, sensor, link)
        self.think()
        while self.is_behind:
            self.think()
        return self.estimate

    def learn(self, activation: Activation, sensor: Poses, link: int = 0) -> Estimate:
        """Take a scan's activations on a link, whose sensor is at a pose (3,) in the world, and
        leave it to the caller when to `think` about it; never raises."""
        self.counters.scans += 1
        self.used = self.unconsidered = None
        self._blind = self._blind or not activation.live.any()
        observation = self._intakes[link].observation(activation, sensor)
        if observation is None:
            self.estimate = self._estimate(max(self.estimate.t, self._t))
            return self.estimate
        self._newest = observation
        self._follow(observation)
        news = self._news[link]
        if observation.live.any():
            self.used = news.on_scan(self._intakes[link].t, observation)
        if self.used is not None:
            self.counters.updates += 1
            # silence is after the last contact on any link
            number = news.contacts if self.used.is_contact else self._tally.contacts
            self.history.add(self.used, number)
            self._conclude(observation, *self.bank.learn(self.used, number))
        else:
            self._conclude(observation)
            self.unconsidered = observation
        return self.estimate

    def taught(self, least: int, link: int = 0) -> Lesson | None:
        """Contacts of which a sure belief has not told a link yet, beside the depths that it
        expects; None where there were less than `least` contacts, or none on this link."""
        number, before = self.estimate.contacts, self._taught[link]
        if self.estimate.status != Status.CONVERGED or number - before < least:
            return None
        self._taught[link] = number
        return self.bank.expected(before, link)

    def relearn(self, scans: Sequence[Used]) -> None:
        """Learn the scans that another estimator has learned from, in their order."""
        for observation, number in scans:
            self.history.add(observation, number)
            self.bank.learn(observation, number)
            while self.bank.is_behind:
                self.bank.revisit()
        while self.bank.is_open and self.bank.revisit():
            pass
        last = max((number for _, number in scans), default=0)
        self._tally.contacts = last
        self._taught = [last] * len(self._taught)  # the skin has its lessons of these
        self.estimate = self._estimate(0.0)

    def restore(self, scans: Sequence[Used]) -> None:
        """Learn the scans of an earlier run; the object may have been moved meanwhile."""
        self.relearn(scans)
        self.bank.restarted(self._tally.contacts)
        self.estimate = self._estimate(0.0)

    def tell(self, pose: PosePrior, of: Sequence[int] | None = None) -> None:
        """Take a prior of the objects numbered `of`, else of any, in place of the one before; the
        paper's rule takes none."""
        numbers = range(len(self.known)) if of is None else of
        self.bank.tell(pose, self._tally.contacts, numbers)
        self.estimate = self._estimate(self.estimate.t)

    @property
    def _t(self) -> float:
        """Time of the newest usable scan [s]."""
        return max(intake.t for intake in self._intakes)

    @property
    def is_behind(self) -> bool:
        """Whether `think` has work that the last touch has left."""
        return self.bank.is_behind

    @property
    def has_thought(self) -> bool:
        """Whether `think` has something to do."""
        return self.is_behind or (self.unconsidered is not None and self.bank.is_open)

    def think(self) -> bool:
        """After a scan that told nothing new, take a second opinion about earlier contacts; →
        whether the estimate has changed."""
        observation, self.unconsidered = self.unconsidered, None
        if observation is None and not self.is_behind:
            return False
        samples = self.bank.revisit()
        if samples:
            self.counters.thoughts += 1
            self._conclude(observation or self._newest, samples)
        return samples > 0

    def _follow(self, observation: Observation) -> None:
        """Move the belief: the object may have been pushed between two scans of one contact."""
        before = self._before[observation.link]
        self._before[observation.link] = observation
        if self.config.motion == "none" or before is None:
            return
        if before.is_contact and observation.is_contact:
            self.bank.follow(before, observation)

    def _conclude(
        self, observation: Observation, injected: int = 0, log_evidence: float = 0.0
    ) -> None:
        """Make an estimate of the current belief."""
        self._blind = self._is_blind(observation)
        self.estimate = self._estimate(self._t, injected, log_evidence)

    def _draw(self, known: Known, observation: Observation, n: int) -> Poses:
        """At most n poses (≤ n, 3) in the world that explain an observation by itself."""
        poses = known.drawn(observation, n, self._rng)
        if len(poses):
            proposal = known.on(observation.link)[1]
            self._kind = ProposalKind[proposal.name.upper()]
        return poses

    def _touches(self, link: int) -> bool:
        """Whether a link touches something, as far as is known: one that fell silent does not."""
        return self._news[link].contact and self._t - self._intakes[link].t <= LOST_S

    def _size_m(self, k: int) -> float:
        """The size of an object: the largest one is not where the skin met nothing."""
        return self.known[k].model.scene.size

    def _is_blind(self, observation: Observation) -> bool:
        """Whether no taxel is live, or none of the taxels that the best pose presses."""
        if observation.live.all() or observation.is_contact:
            return False
        if not observation.live.any():
            return True
        best = self.rule.place.summary.modes[0].pose
        model, _ = self.known[self.bank.best].on(observation.link)
        pressed = model.pressed_from(observation.sensor[None], best[None]).taxel
        expected = self._tally.contacts > 0 and len(pressed) > 0
        return expected and not bool(observation.live[pressed].any())

    def _estimate(self, t: float, injected: int = 0, log_evidence: float = 0.0) -> Estimate:
        bank = self.bank
        verdict, modes = bank.verdict, bank.modes()
        place, summary = verdict.place, verdict.place.summary
        return Estimate(
            t=t,
            status=status(verdict, self._tally.contacts, blind=self._blind),
            contact=any(map(self._touches, range(len(self._news)))),
            contacts=self._tally.contacts,
            map=summary.modes[0].pose,
            mean=summary.mean,
            cov=summary.cov,
            modes=modes,
            p=verdict.p,
            radius_m=place.radius_m,
            hypotheses=verdict.hypotheses,
            object=bank.best,
            objects=tuple(bank.objects.tolist()),
            ess=summary.ess,
            particles=summary.particles,
            injected=injected,
            proposal=self._kind,
            log_evidence=log_evidence,
        )
