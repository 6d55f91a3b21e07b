"""The rule that remembers: samples are weighed by all that is remembered, and merged with the
belief by their evidence."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.estimate import MODE_RADIUS_M, SURE, Place, placed
from taxeld.estimator.evidence import LEAST, UNTOUCHED, ModelEvidence, inherited, odds
from taxeld.estimator.memory import Memory, ObjectSkin, Slack
from taxeld.estimator.particles import Belief, Support
from taxeld.estimator.priors import BeliefPrior, PriorTerm
from taxeld.estimator.scans import ScanEvidence, noise_of, surplus
from taxeld.model.observation import Lesson, Observation, ObservationModel
from taxeld.model.push import STRIDE, Push, assumed, changed, push
from taxeld.model.symmetry import PoseMetric
from taxeld.prior import PosePrior

Draw = Callable[[Observation, int], Poses]
"""Poses (≤ n, 3) in the world that explain a contact by itself; none of a silent scan."""

PUSHED_M = 2e-4  # m between two scans: a shorter way is a press that settles
ROOM = 3.0  # half-widths of the table around the last touch: the whole table, and more
TELLING = 1.0  # nats that a silent scan must cost some particle to be remembered
SCALES = np.array([0.0, 0.5, 1.0, 2.0])  # candidate factors on the configured slack
EXPECTING = 32  # poses by which a belief tells what it expects
FITTING = 32  # particles by which the slack is fitted, about
SLACK_NATS = 1.0  # nats of evidence needed to change the slack
SEARCHES = 2  # after a contact, at most
SEARCHED = 4  # contacts whose samples a search takes
MISSED = 0.02  # probability, until a search has found nothing else, that the belief has missed it
OPINIONS = 2  # contacts with whose samples an object begins that was ruled out before


class Mixture:
    """A belief about one object: every remembered scan counts, and samples are weighed against all
    of them."""

    def __init__(
        self,
        model: ObservationModel,
        config: FilterConfig,
        robot_m: float,
        rng: np.random.Generator,
        draw: Draw,
    ) -> None:
        self._model, self._config, self._rng, self._draw = model, config, rng, draw
        # with pushing, the prior already covers the unknown part of a push
        slack = Slack(robot_m, config.nudge_m) if config.motion == "none" else Slack()
        self.memory = Memory(ObjectSkin.of(model, noise_of(config)), slack)
        self.belief = pf.uniform(config, rng)
        self.metric = PoseMetric(model.scene)
        self.log_z = 0.0  # log evidence of all that is remembered, in relation to readings alone
        self._scale = self.metric.scale
        self._evidence = ModelEvidence(model, self.metric)
        self._place: Place | None = None  # of the present belief
        self._before = placed(self.belief, self.metric, config)  # the last one asked for
        self.weighed = UNTOUCHED
        self.share = 1.0  # probability of its object among those that it may be
        self.push: Push = push
        self._stands = 1.0  # probability that this object has stood, were it the only one known
        self._searches = 0  # since the last contact
        self._is_sure = False  # but for what a search may find
        self._is_searched = False  # whether it was sure before and after a search or a touch
        self._fitted = 0  # number of the contact after which the slack was fitted

    def follow(self, before: Observation, after: Observation) -> None:
        """Move the belief with an object that is pushed from one scan to the next. A prior takes
        the place of the memory: its scans were taken where the object no longer is."""
        belief, metric = self.belief, self.metric
        if not belief.ground.size:
            belief.ground = assumed(len(belief), self._rng)
        model = self._model.links[after.link]
        pose, pushed = self.push(
            model,
            metric,
            belief.pose,
            belief.ground,
            before.sensor,
            after.sensor,
            float(after.z.max()) * model.depth_max_m,
            self._rng,
        )
        pushed_m = float(belief.weight @ pushed)
        if pushed_m < PUSHED_M:
            return
        belief.pose = pose
        strides = pushed_m / (STRIDE * self._model.scene.mean_radius)
        belief.ground = changed(belief.ground, strides, self._rng)
        modes = placed(belief, metric, self._config).modes
        prior = BeliefPrior(metric, pose, belief.weight, modes, self._evidence.log_volume)
        self.memory, self.log_z = self.memory.anew(prior), 0.0
        belief.remembered = self.memory.explain(pose)
        self._place = None

    def take(self, scan: ScanEvidence) -> tuple[int, float]:
        """Learn from a scan; → the number of samples injected, and the scan's log evidence."""
        samples = self._draw(scan.observation, self._wanted)
        belief, before = self.belief, self.memory
        known = before.runs.support(belief.remembered)
        # the object may have moved since the last contact, so what is remembered grows older
        if before.slack.nudge_m and scan.number > before.newest:
            self.memory = memory = before.plus(scan, self.log_z)
            explained = memory.explain(belief.pose)
        else:
            newest = before.explain_next(scan, belief.pose)
            if not scan.is_contact and scan.anything - newest.min() < TELLING:
                return 0, 0.0
            self.memory = memory = before.plus(scan, self.log_z)
            explained = np.column_stack([belief.remembered, newest])
        belief.remembered = explained
        evidence = pf.reweight(belief, memory.runs.support(explained) - known)
        if evidence is None:
            evidence = 0.0
            self._begin_anew(scan, samples)
        else:
            self._forget_surplus()
            if len(samples):
                self._searches = 0
                opinion = self.opinion(samples, len(self.memory) - 1, self._rng)
                is_known = memory.prior is not None or memory.term is not None
                if self._has_more or is_known:
                    opinion = self._merged(opinion)
                self._become(opinion)
                self._fit_slack()
            elif pf.resampling_is_due(self.belief):
                self._become(self.belief)
        # silence that the belief expected changes no verdict, and before a touch there is none
        is_felt = bool(self.memory.contact.any()) or self.memory.prior is not None
        if len(samples) or (is_felt and abs(evidence) > 1.0 - SURE):
            self._judge(has_looked=len(samples) > 0 and not self._has_more)
        return len(samples), evidence

    def tell(self, pose: PosePrior, contacts: int) -> None:
        """Take a prior after contact number `contacts`."""
        term = PriorTerm(pose, self.metric, self._config, self._evidence.log_volume, contacts + 1)
        before, self.memory = self.memory, self.memory.told(term, self.log_z)
        if not before.contact.any() and before.prior is None:
            self._believe(term)
            return
        memory, belief = self.memory, self.belief
        known = before.runs.support(belief.remembered)
        belief.remembered = memory.explain(belief.pose)
        pf.reweight(belief, memory.runs.support(belief.remembered) - known)
        at = memory.terms - len(memory) - 1  # the term's column
        samples = term.samples(max(self._wanted, 1), self._rng)
        opinion = self._weighed(samples, lambda explained: explained[:, at], self._rng)
        self._become(self._merged(opinion))
        self._searches, self._is_searched = 0, False
        self._judge(has_looked=False)

    def _believe(self, term: PriorTerm) -> None:
        """Before the first touch: particles of the prior, and of the whole table."""
        n = max(round(term.pose.weight * self._config.particles), 1)
        belief = pf.uniform(self._config, self._rng)
        belief.pose[:n] = term.samples(n, self._rng)
        belief.remembered = self.memory.explain(belief.pose)
        pf.reweight(belief, self.memory.of_scans(belief.remembered).sum(axis=1))
        self.belief, self._place = belief, None

    @property
    def is_open(self) -> bool:
        """Whether a search is due: once before the belief may be sure."""
        few = self._searches < SEARCHES
        return self._is_sure and not self._is_searched and few and self._has_more

    @property
    def _has_more(self) -> bool:
        """Whether more than one contact is remembered."""
        return int(np.count_nonzero(self.memory.contact)) > 1

    def search(self) -> int:
        """Merge the belief with samples of several remembered contacts; → how many."""
        contacts, found, wanted = np.flatnonzero(self.memory.contact), 0, self._wanted
        for scan in self._rng.permutation(contacts)[:SEARCHED].tolist():
            samples = self._draw(self.memory.scans[scan].remembered, wanted)
            if len(samples):
                self.belief = self._merged(self.opinion(samples, scan, self._rng))
                found += len(samples)
        if not found:  # there is no time
            return 0
        self._searches += 1
        self._become(self.belief)
        self._judge(has_looked=True)
        return found

    def adopt(self, memory: Memory) -> int:
        """Begin with the scans that another object's `memory` has; → the number of samples used."""
        self.memory = self.memory.adopted(memory)
        self.belief = pf.uniform(self._config, self._rng)
        self._searches, self._is_searched = 0, False
        contacts, used = np.flatnonzero(self.memory.contact)[::-1], 0
        for scan in contacts[:: max(len(contacts) // OPINIONS, 1)][:OPINIONS].tolist():
            samples = self._draw(self.memory.scans[scan].remembered, self._config.injected)
            if not len(samples):
                continue
            opinion = self.opinion(samples, scan, self._rng)
            self._become(self._merged(opinion) if used else opinion)
            used += len(samples)
        if not used:
            self.belief.remembered = self.memory.explain(self.belief.pose)
        self._judge(has_looked=False)
        return used

    def expected(self, after: int, link: int) -> Lesson | None:
        """The remembered contacts of a link after number `after`, and the depths that the belief
        expects of them; None where nothing is remembered."""
        memory = self.memory
        told = memory.contact & (memory.number > after) & (memory.link == link)
        if not told.any():
            return None
        drawn = pf.resample(self.belief, EXPECTING, np.random.default_rng(0))
        return memory.only(told).contacts_at(drawn.pose, link)

    def opinion(
        self, samples: Poses, scan: int, rng: np.random.Generator, power: float = 1.0
    ) -> Belief:
        """Samples (S, 3) of scan number `scan`, weighed by the whole memory in place of that scan
        alone; `power`: of the memory's likelihood."""
        memory = self.memory
        at = memory.terms - len(memory) + scan  # the scan's column
        samples = samples.copy()
        samples[:, :2] += np.sqrt(memory.variance[scan]) * rng.standard_normal((len(samples), 2))

        def own(explained: Floats) -> Floats:
            return np.asarray(np.logaddexp(explained[:, at] - memory.anything[scan], LEAST))

        return self._weighed(samples, own, rng, power)

    def _weighed(
        self, samples: Poses, own: Support, rng: np.random.Generator, power: float = 1.0
    ) -> Belief:
        """Samples (S, 3) of log-density `own`, weighed and drawn anew by that of the belief, to
        this power."""
        opinion = pf.equal(samples, self.memory.explain(samples))
        explained = opinion.remembered
        opinion.log_weight = power * self.memory.runs.support(explained) - own(explained)
        pf.normalise(opinion)
        return pf.resample(opinion, len(samples), rng)

    @property
    def _wanted(self) -> int:
        """Number of samples: as configured; in proportion more while the belief is wide or
        unlikely, but no more than it has particles."""
        config = self._config
        size = self._most if self._stands < 0.5 else len(self.belief)
        return max(config.injected, min(round(config.injected * size / config.particles), size))

    def _judge(self, *, has_looked: bool) -> None:
        """Weigh the hypotheses, and find how sure the belief is. `has_looked`: whether samples of
        another contact were merged."""
        self.weighed = UNTOUCHED
        if len(self.memory):
            self.weighed = self._evidence.weighed(self.belief, self.memory.runs)
            self.log_z = self.weighed.log_z
        alone = odds([self.weighed])
        self._stands = alone.hypotheses.stands
        was_sure, before = self._is_sure, self._before
        now = placed(self.belief, self.metric, self._config)
        self._is_sure = float(alone.here[0]) * now.within >= SURE
        apart = self.metric.distance(before.modes[0].pose, now.modes[0].pose)
        stays = was_sure and self._is_sure and bool(apart < MODE_RADIUS_M * self._scale)
        self._is_searched = stays and (self._is_searched or has_looked)
        self._take_place(now)

    @property
    def place(self) -> Place:
        """Where the belief has the object."""
        return self._place or self._take_place(placed(self.belief, self.metric, self._config))

    def _take_place(self, place: Place) -> Place:
        """Remember the place, less the probability that no particle is where the object is."""
        found = 1.0 if self._is_searched else 1.0 - MISSED
        self._place = self._before = replace(place, within=found * place.within)
        return self._place

    def _fit_slack(self) -> None:
        """Fit the slack to the evidence: contacts that agree exactly are believed exactly, others
        get more room. Each contact moves the slack by one step."""
        memory, belief = self.memory, self.belief
        now = memory.slack
        if memory.newest == self._fitted or not (now.robot_m or now.nudge_m):
            return
        self._fitted = memory.newest
        at = int(np.flatnonzero(now.scale == SCALES)[0])
        others = [scale for scale in SCALES[max(at - 1, 0) : at + 2].tolist() if scale != now.scale]
        tried = [replace(memory, slack=replace(now, scale=scale)) for scale in others]
        support, some = memory.runs.support, slice(None, None, max(len(belief) // FITTING, 1))
        known = support(belief.remembered)
        gains = [support(each.explain(belief.pose[some])) - known[some] for each in tried]
        gained = [pf.log_sum_exp(gain) - np.log(len(gain)) for gain in gains]
        best = int(np.argmax(gained))
        if gained[best] > SLACK_NATS:
            self.memory = tried[best]
            belief.remembered = self.memory.explain(belief.pose)
            pf.reweight(belief, support(belief.remembered) - known)
            self._become(belief)

    def _begin_anew(self, scan: ScanEvidence, samples: Poses) -> None:
        """Begin with the samples (S, 3) of a contact, or with a uniform belief."""
        self.memory, self.log_z = self.memory.anew(), 0.0
        self.belief = pf.uniform(self._config, self._rng)
        if len(samples):
            self.memory = self.memory.plus(scan, self.log_z)
            opinion = pf.equal(samples, self.memory.explain(samples))
            self._become(opinion)

    def _merged(self, opinion: Belief) -> Belief:
        """The belief merged with an opinion. Samples know nothing of how the object slides,
        so each takes the ground of a particle."""
        belief = self.belief
        if belief.ground.size:
            opinion.ground = pf.resample(belief, len(opinion), self._rng).ground
        runs, evidence = self.memory.runs, self._evidence
        return pf.merge(belief, evidence.of(belief, runs), opinion, evidence.of(opinion, runs))

    def _become(self, belief: Belief) -> None:
        """Resample to the number of equal particles that this width needs, and separate the
        copies by a move."""
        self.belief = pf.resample(belief, self._size(belief), self._rng)
        memory, touch = self.memory, self.memory.last_touch
        # around the last touch, as the sensor may have gone elsewhere since
        centre = np.array(self._config.centre_m) if touch is None else touch
        room = pf.Room(centre, ROOM * self._config.half_width_m)
        support = memory.runs.support
        pf.rejuvenate(self.belief, memory.explain, support, self._rng, self._scale, room)

    def _size(self, belief: Belief) -> int:
        config = self._config
        if self._most <= config.particles:
            return config.particles
        drawn = pf.resample(belief, config.particles, self._rng)
        wanted = pf.enough(
            pf.occupied(self.metric.reduced(drawn.pose), pf.CELL * [self._scale, self._scale, 1.0])
        )
        return min(max(wanted, config.particles), self._most)

    @property
    def _most(self) -> int:
        """Particles at most: an unlikely object takes fewer."""
        return max(round(self.share * self._config.particles_max), self._config.particles)

    def _forget_surplus(self) -> None:
        """Forget the scan that is too many. What it told counts on: had the object to be found
        anew by the scans that are left, it would seem to have moved."""
        memory, belief, forgotten = self.memory, self.belief, surplus(self.memory.scans)
        if forgotten is None:
            return
        kept = np.arange(len(memory)) != forgotten
        terms = np.full(memory.terms, True)
        memory.of_scans(terms)[:] = kept
        explained, fewer = belief.remembered[:, terms], memory.only(kept)
        gained = inherited(belief, memory.runs, fewer.runs, explained)
        self.memory, self.log_z = fewer.after_loss(gained), self.log_z - float(gained[0])
        belief.remembered = explained
