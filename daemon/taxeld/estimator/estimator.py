"""The estimator: activations and sensor poses in, estimates out. No clock, no socket, no file.

It takes the usable part of a scan, picks the scans to learn from (`news`), reads them (`scans`),
and has the belief in each known object learn from them (`bank`), which also says how sure it is.
docs/estimator.md is the model behind these.
"""

import hashlib
from collections.abc import Sequence
from functools import cached_property, partial

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig, SensorPoseConfig
from taxeld.estimator.bank import Bank, Known
from taxeld.estimator.estimate import Estimate, ProposalKind, Status, status
from taxeld.estimator.news import EstimatorCounters, Intake, News
from taxeld.estimator.object_belief import ObjectBelief
from taxeld.estimator.paper import Paper
from taxeld.estimator.scans import VERSION, Reader, ScanEvidence, Used, noise_of
from taxeld.model import se2
from taxeld.model.contacts import Proposal
from taxeld.model.observation import Activation, Lesson, Observation, ObservationModel
from taxeld.prior import PosePrior

RULES = {"paper": Paper, "mixture": ObjectBelief}
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
        self._rng = np.random.default_rng(config.seed)
        self.bank = Bank(
            [
                RULES[config.injection](
                    known.model, config, self.robot_m, self._rng, partial(self._draw, known)
                )
                for known in self.known
            ],
            # the largest object is not where the skin met nothing
            first=int(np.argmax([known.model.scene.size for known in self.known])),
        )
        self._reader = Reader(links, noise_of(config))
        self._kind = ProposalKind.NONE  # proposal of the last samples
        self._intakes = [Intake(each, self.counters, k) for k, each in enumerate(links)]
        self._news = [News(each.layout.radius_m) for each in links]
        self._contacts = 0  # begun so far, on all links
        self._number = [0] * len(links)  # of the last contact on each link
        self._taught = [0] * len(links)  # of the last contact of which `taught` has told
        self._before: list[Observation | None] = [None] * len(links)
        self._blind = False  # no live taxel would feel it, until a usable scan tells more
        self.used: Observation | None = None  # the scan that the last call learned from
        self._newest: Observation | None = None  # the last usable scan
        self._is_unconsidered = False  # whether the last scan told nothing, until `think`
        self.estimate = self._estimate(0.0)

    @property
    def scans(self) -> Sequence[ScanEvidence]:
        """What the belief remembers, to be learned by another estimator; never changed: each scan
        makes another one."""
        return self.belief.memory.scans

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
    def belief(self) -> ObjectBelief:
        """The belief about the likeliest object."""
        return self.bank.belief

    def on_scan(
        self, activation: Activation, sensor: Poses, link: int = 0, *, thinks: bool = True
    ) -> Estimate:
        """Take a scan's activations on a link, whose sensor is at a pose (3,) in the world; never
        raises. Without `thinks` it is left to the caller when to `think` about it."""
        self.counters.scans += 1
        self.used, self._is_unconsidered = None, False
        self._blind = self._blind or not activation.live.any()
        observation = self._intakes[link].observation(activation, sensor)
        if observation is None:
            self.estimate = self._estimate(max(self.estimate.t, self._t))
        else:
            self._newest = observation
            self._follow(observation)
            if observation.live.any():
                self.used = self._new(observation)
            if self.used is None:
                self._conclude()
                self._is_unconsidered = True
            else:
                self.counters.updates += 1
                # silence is after the last contact on any link
                number = self._number[link] if self.used.is_contact else self._contacts
                self._conclude(*self.bank.take(self._reader.read(self.used, number)))
        if thinks:
            self.think()
            while self.bank.is_behind:
                self.think()
        return self.estimate

    def learn(self, scans: Sequence[Used], *, moved: bool = False) -> None:
        """Learn the scans that another estimator has learned from, in their order. `moved`: the
        object may have been moved since then."""
        for observation, number in scans:
            self.bank.take(self._reader.read(observation, number))
            while self.bank.is_behind:
                self.bank.revisit()
        while self.bank.is_open and self.bank.revisit() is not None:
            pass
        self._contacts = max((number for _, number in scans), default=0)
        self._taught = [self._contacts] * len(self._taught)  # the skin has its lessons of these
        if moved:
            self.bank.restarted(self._contacts)
        self.estimate = self._estimate(0.0)

    def taught(self, least: int, link: int = 0) -> Lesson | None:
        """Contacts of which a sure belief has not told a link yet, beside the depths that it
        expects; None where there were less than `least` contacts, or none on this link."""
        number, before = self.estimate.contacts, self._taught[link]
        if self.estimate.status != Status.CONVERGED or number - before < least:
            return None
        self._taught[link] = number
        return self.belief.expected(before, link)

    def take_prior(self, pose: PosePrior, of: Sequence[int] | None = None) -> None:
        """Take a prior of the objects numbered `of`, else of any, in place of the one before; the
        paper's rule takes none."""
        self.bank.take_prior(pose, self._contacts, range(len(self.known)) if of is None else of)
        self.estimate = self._estimate(self.estimate.t)

    @property
    def has_thought(self) -> bool:
        """Whether `think` has something to do."""
        return self.bank.is_behind or (self._is_unconsidered and self.bank.is_open)

    def think(self) -> bool:
        """Have another object learn the next scan that waits; or, after a scan with nothing new,
        search by earlier contacts; → whether the estimate has changed."""
        is_due, self._is_unconsidered = self._is_unconsidered or self.bank.is_behind, False
        if not is_due:
            return False
        samples = self.bank.revisit()
        if samples is None:
            return False
        self.counters.thoughts += 1
        self._conclude(samples)
        return True

    @property
    def _t(self) -> float:
        """Time of the newest usable scan [s]."""
        return max(intake.t for intake in self._intakes)

    def _new(self, observation: Observation) -> Observation | None:
        """The scan to learn from after this one, if there is one; a contact that begins gets a
        number."""
        link = observation.link
        news, begun = self._news[link], self._news[link].contacts
        used = news.on_scan(self._intakes[link].t, observation)
        if news.contacts > begun:
            self._contacts += 1
            self._number[link] = self._contacts
        return used

    def _follow(self, observation: Observation) -> None:
        """Move the belief: the object may have been pushed between two scans of one contact."""
        before = self._before[observation.link]
        self._before[observation.link] = observation
        if self.config.motion == "none" or before is None:
            return
        if before.is_contact and observation.is_contact:
            self.bank.follow(before, observation)

    def _conclude(self, injected: int = 0, log_evidence: float = 0.0) -> None:
        """Make an estimate of the current belief."""
        if self._newest is not None:
            self._blind = self._is_blind(self._newest)
        self.estimate = self._estimate(self._t, injected, log_evidence)

    def _draw(self, known: Known, observation: Observation, n: int) -> Poses:
        """At most n poses (≤ n, 3) in the world that explain a contact by itself; none of a silent
        scan."""
        if not n or not observation.is_contact:
            return np.empty((0, 3))
        poses = known.drawn(observation, n, self._rng)
        if len(poses):
            proposal = known.on(observation.link)[1]
            self._kind = ProposalKind[proposal.name.upper()]
        return poses

    def _is_blind(self, observation: Observation) -> bool:
        """Whether no taxel is live, or none of the taxels that the best pose presses."""
        if observation.live.all() or observation.is_contact:
            return False
        if not observation.live.any():
            return True
        best = self.belief.place.modes[0].pose
        model, _ = self.known[self.bank.best].on(observation.link)
        pressed, _ = model.pressed(se2.compose(se2.inverse(observation.sensor), best)[None])
        expected = self._contacts > 0 and len(pressed) > 0
        return expected and not bool(observation.live[pressed].any())

    def _estimate(self, t: float, injected: int = 0, log_evidence: float = 0.0) -> Estimate:
        bank, verdict = self.bank, self.bank.verdict
        place, modes = verdict.place, bank.modes()
        # a link that fell silent in a touch touches nothing, as far as is known
        touches = (
            news.contact and self._t - intake.t <= LOST_S
            for news, intake in zip(self._news, self._intakes, strict=True)
        )
        return Estimate(
            t=t,
            status=status(verdict, self._contacts, blind=self._blind),
            contact=any(touches),
            contacts=self._contacts,
            map=place.modes[0].pose,
            mean=place.mean,
            cov=place.cov,
            modes=modes,
            p=verdict.p,
            radius_m=place.radius_m,
            hypotheses=verdict.hypotheses,
            object=bank.best,
            objects=tuple(bank.odds.objects.tolist()),
            ess=place.ess,
            particles=place.particles,
            injected=injected,
            proposal=self._kind,
            log_evidence=log_evidence,
        )
