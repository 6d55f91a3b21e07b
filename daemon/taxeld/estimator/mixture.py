"""The rule that remembers: samples are brought to explain all that is remembered, and merged with
the belief by their evidence."""

from dataclasses import replace

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import injection
from taxeld.estimator import particles as pf
from taxeld.estimator.estimate import MODE_RADIUS_M, SURE, summarise
from taxeld.estimator.evidence import UNTOUCHED, ModelEvidence, odds
from taxeld.estimator.memory import Memory, Prior, Slack
from taxeld.estimator.particles import Belief
from taxeld.estimator.prior_term import PriorTerm, TableTop
from taxeld.estimator.rule import PUSHED_M, Draw, anew, drawn, noise_of
from taxeld.estimator.verdict import Place, placed
from taxeld.model.observation import Lesson, Observation, ObservationModel
from taxeld.model.push import STRIDE, Push, assumed, changed, push
from taxeld.model.symmetry import PoseMetric
from taxeld.prior import PosePrior

ROOM = 3.0  # half-widths of the table around the last touch: the whole table, and more
MOVES = 2  # Metropolis steps a contact
REMEMBERED = 16  # scans of touches remembered at most
SILENT_MAX = 32  # silent scans remembered at most
TELLING = 1.0  # nats that a silent scan must cost some particle to be remembered
SCALES = np.array([0.0, 0.5, 1.0, 2.0])  # candidate factors on the configured slack
EXPECTING = 32  # poses by which a belief tells what it expects
SLACK_NATS = 1.0  # nats of evidence needed to change the slack
REVISITS = 3  # second opinions after a contact, at most
OPINIONS = 2  # contacts with whose samples an object begins that was ruled out before
AGREED = 2  # opinions in a row that leave a sure belief in place are enough
MISSED = 0.02  # probability, until then, that no particle is where the object is


class Mixture:
    """Every remembered scan counts, and samples are weighed against all of them."""

    def __init__(
        self,
        model: ObservationModel,
        config: FilterConfig,
        robot_m: float,
        rng: np.random.Generator,
    ) -> None:
        self._model, self._config, self._rng = model, config, rng
        # with pushing, the prior already covers the unknown part of a push
        slack = Slack(robot_m, config.nudge_m) if config.motion == "none" else Slack()
        self.memory = Memory(model, noise_of(config), slack=slack)
        self.belief = anew(config, rng)
        self.metric = PoseMetric(model.scene)
        self.log_z = 0.0  # log evidence of all that is remembered, in relation to readings alone
        self._scale = self.metric.scale
        self._evidence = ModelEvidence(model, self.metric)
        self._place: Place | None = None  # of the present belief
        self._before = placed(self.belief, self.metric, config)  # the last one asked for
        self.weighed = UNTOUCHED
        self.share = 1.0
        self.push: Push = push
        self._stands = 1.0  # probability that this object has stood, were it the only one known
        self._revisits = 0  # second opinions since the last contact
        self._agreed = 0  # opinions in a row that left a sure belief in place
        self._fitted = 0  # number of the contact after which the slack was fitted

    def follow(self, before: Observation, after: Observation) -> None:
        """Replace the memory by a prior: its scans were taken where the object no longer is."""
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
        modes = summarise(belief, metric).modes
        prior = Prior(metric, pose, belief.weight, modes, self._evidence.log_volume)
        self.memory, self.log_z = self.memory.anew(prior), 0.0
        belief.remembered = self.memory.explain(pose)
        self._place = None

    def learn(self, observation: Observation, contacts: int, draw: Draw) -> tuple[int, float]:
        samples = drawn(draw, observation, self._wanted())
        log_evidence = self._update(observation, samples, contacts)
        if log_evidence is None:
            return 0, 0.0
        # silence that the belief expected changes no verdict, and before a touch there is none
        is_felt = bool(self.memory.contact.any()) or self.memory.prior is not None
        if len(samples) or (is_felt and abs(log_evidence) > 1.0 - SURE):
            self._judge(opinions=int(len(samples) > 0))
        return len(samples), log_evidence

    def tell(self, pose: PosePrior, contacts: int) -> None:
        """Take a prior after contact number `contacts`."""
        config, memory = self._config, self.memory
        table = TableTop.of(self.metric, config, self._evidence.log_volume)
        term = PriorTerm(pose, table, contacts + 1)
        self.memory = memory.given(term, self.log_z)
        if not memory.contact.any() and memory.prior is None:
            self._believe(term)
            return
        belief, known = self.belief, memory.runs.support(self.belief.remembered)
        belief.remembered = self.memory.explain(belief.pose)
        pf.reweight(belief, self.memory.runs.support(belief.remembered) - known)
        samples = term.samples(max(self._wanted(), 1), self._rng)
        at = self.memory.terms - len(self.memory) - 1  # the term's column
        opinion = injection.anneal(
            pf.equal(samples, self.memory.explain(samples)),
            lambda explained: np.asarray(explained[:, at]),
            self.memory.runs.support,
            self.memory.explain,
            self._rng,
            self._scale,
        )
        self._become(self._merged(opinion), moves=1)
        self._revisits = self._agreed = 0
        self._judge(opinions=0)

    def _believe(self, term: PriorTerm) -> None:
        """Before the first touch: particles of the prior, and of the whole table."""
        n = max(round(term.pose.weight * self._config.particles), 1)
        belief = anew(self._config, self._rng)
        belief.pose[:n] = term.samples(n, self._rng)
        belief.remembered = self.memory.explain(belief.pose)
        silence = self.memory.of_scans(belief.remembered).sum(axis=1)
        pf.reweight(belief, silence)
        self.belief, self._place = belief, None

    def _update(self, observation: Observation, samples: Poses, number: int) -> float | None:
        """Learn from a scan of contact `number`, or a silent scan after it, and from `samples` (S,
        3) of that scan, without judging the result; → log evidence, None where nothing was
        learned."""
        self._age(number)
        belief, before = self.belief, self.memory
        memory = before.plus(observation, number, self.log_z)
        newest = memory.explain_newest(belief.pose)
        if not observation.is_contact and memory.anything[-1] - newest.min() < TELLING:
            return None
        self.memory, known = memory, before.runs.support(belief.remembered)
        belief.remembered = np.column_stack([belief.remembered, newest])
        evidence = pf.reweight(belief, memory.runs.support(belief.remembered) - known)
        if evidence is None:
            self._begin_anew(observation, samples, number)
            return 0.0
        self._keep_to_size()
        if len(samples):
            self._take(samples)
            self._fit_slack()
        elif pf.resampling_is_due(self.belief):
            self._become(self.belief, moves=1)
        return evidence

    def _age(self, number: int) -> None:
        """Let the remembered scans age when a contact begins, as the object may have moved."""
        memory, belief = self.memory, self.belief
        if not memory.slack.nudge_m or not len(memory) or number <= memory.newest:
            return
        memory.newest = number
        aged, support = memory.explain(belief.pose), memory.runs.support
        pf.reweight(belief, support(aged) - support(belief.remembered))
        belief.remembered = aged

    @property
    def is_open(self) -> bool:
        few = self._revisits < REVISITS and self._agreed < AGREED
        return few and int(np.count_nonzero(self.memory.contact)) > 1

    def revisit(self, draw: Draw) -> int:
        """Take a second opinion, brought to explain all contacts: first the belief turned by half
        where that is another pose, then samples of a remembered contact."""
        if not self.is_open or not self._wanted():
            return 0
        if not self._revisits and self.metric.order % 2:
            opinion = self._turned()
        else:
            memory = self.memory
            scan = int(self._rng.choice(np.flatnonzero(memory.contact)))
            samples = drawn(draw, memory.scan(scan), self._wanted())
            if not len(samples):  # none were asked for, or there is no time
                return 0
            opinion = self.opinion(samples, scan, self._rng)
        self._revisits += 1
        self._become(self._merged(opinion), moves=1)
        self._judge(opinions=1)
        return len(opinion)

    def _turned(self) -> Belief:
        """An opinion of the poses a half turn from the belief. What two faces of an object feel
        like is often much the same on opposite sides, and samples may reach one of these alone."""
        poses = pf.resample(self.belief, self._wanted(), self._rng).pose
        turned = self.metric.placed(self.metric.centres(poses), poses[:, 2] + np.pi)
        opinion = pf.equal(turned, np.empty((len(turned), 0)))
        pf.roughen(opinion, self._rng, self._scale)
        opinion.remembered = self.memory.explain(opinion.pose)
        return injection.anneal(
            opinion,
            lambda explained: np.zeros(len(explained)),
            self.memory.runs.support,
            self.memory.explain,
            self._rng,
            self._scale,
        )

    def adopt(self, memory: Memory, draw: Draw) -> int:
        """Begin with the scans that another object's `memory` has; → the number of samples used."""
        self.memory = self.memory.adopted(memory)
        self.belief, self._revisits, self._agreed = anew(self._config, self._rng), 0, 0
        contacts, used = np.flatnonzero(self.memory.contact)[::-1], 0
        for scan in contacts[:: max(len(contacts) // OPINIONS, 1)][:OPINIONS].tolist():
            samples = drawn(draw, self.memory.scan(scan), self._config.injected)
            if not len(samples):
                continue
            opinion = self.opinion(samples, scan, self._rng)
            self._become(self._merged(opinion) if used else opinion, moves=MOVES)
            used += len(samples)
        if not used:
            self.belief.remembered = self.memory.explain(self.belief.pose)
        self._judge(opinions=0)
        return used

    def expected(self, after: int, link: int, /) -> Lesson | None:
        memory = self.memory
        told = memory.contact & (memory.number > after) & (memory.link == link)
        if not told.any():
            return None
        drawn = pf.resample(self.belief, EXPECTING, np.random.default_rng(0))
        return memory.only(told, prior=False).contacts_at(drawn.pose, link)

    def _wanted(self) -> int:
        """Number of samples: as configured, and more while the belief is wide or unlikely."""
        config = self._config
        size = self._most if self._stands < 0.5 else len(self.belief)
        return round(config.injected * max(size / config.particles, 1.0))

    def _judge(self, opinions: int) -> None:
        """Weigh the hypotheses, and find how sure the belief is, after so many opinions more."""
        self.weighed = UNTOUCHED
        if len(self.memory):
            self.weighed = self._evidence.weighed(self.belief, self.memory.runs)
            self.log_z = self.weighed.log_z
        alone = odds([self.weighed])
        self._stands, self._place = alone.hypotheses.stands, None
        if not (opinions or self._agreed):
            return
        before, now = self._before, placed(self.belief, self.metric, self._config)
        apart = self.metric.distance(before.summary.modes[0].pose, now.summary.modes[0].pose)
        is_sure = float(alone.here[0]) * now.within >= SURE
        stays = is_sure and apart < MODE_RADIUS_M * self._scale
        self._agreed = self._agreed + opinions if stays else 0
        self._place = self._before = self._searched(now)

    def _searched(self, place: Place) -> Place:
        """The place with the probability that no particle is where the object is."""
        searched = 1.0 if self._agreed >= AGREED else 1.0 - MISSED
        return replace(place, within=searched * place.within)

    @property
    def place(self) -> Place:
        """Where the belief has the object."""
        if self._place is None:
            found = placed(self.belief, self.metric, self._config)
            self._place = self._before = self._searched(found)
        return self._place

    def _fit_slack(self) -> None:
        """Fit the slack to the evidence: contacts that agree exactly are believed exactly, others
        get more room. Each contact moves the slack by one step."""
        memory, belief = self.memory, self.belief
        now = memory.slack
        if memory.newest == self._fitted or not (now.robot_m or now.nudge_m):
            return
        self._fitted = memory.newest
        support = memory.runs.support
        usual = support(belief.remembered)
        at = int(np.flatnonzero(now.scale == SCALES)[0])
        gained = {}
        for scale in SCALES[max(at - 1, 0) : at + 2].tolist():
            if scale != now.scale:
                memory.slack = replace(now, scale=scale)
                gained[memory.slack] = _log_mean(support(memory.explain(belief.pose)) - usual)
        likeliest = max(gained, key=gained.__getitem__)
        memory.slack = likeliest if gained[likeliest] > SLACK_NATS else now
        if memory.slack is not now:
            remembered = memory.explain(belief.pose)
            pf.reweight(belief, support(remembered) - usual)
            belief.remembered = remembered
            self._become(belief, moves=1)

    def _begin_anew(self, observation: Observation, samples: Poses, number: int) -> None:
        """Begin with the samples (S, 3) of a contact, or with a uniform belief."""
        self.memory = self.memory.anew()
        self.log_z = 0.0
        self.belief = anew(self._config, self._rng)
        if len(samples):
            self.memory = self.memory.plus(observation, number, self.log_z)
            opinion = pf.equal(samples, self.memory.explain(samples))
            self._become(opinion, moves=MOVES)

    def _take(self, samples: Poses) -> None:
        """Merge the samples' (S, 3) opinion of the whole memory with the belief."""
        self._revisits = 0
        memory = self.memory
        opinion = self.opinion(samples, len(memory) - 1, self._rng)
        is_known = memory.prior is not None or memory.term is not None
        if np.count_nonzero(memory.contact) > 1 or is_known:
            opinion = self._merged(opinion)
        self._become(opinion, moves=MOVES)

    def opinion(
        self, samples: Poses, scan: int, rng: np.random.Generator, strictness: float = 1.0
    ) -> Belief:
        """Samples (S, 3) of scan number `scan`, brought to explain the whole memory; `strictness`:
        power of its likelihood."""
        memory = self.memory
        alone = memory.only(np.arange(len(memory)) == scan, prior=False)
        own = np.zeros((memory.terms, 1))
        memory.of_scans(own.T)[0, scan] = 1.0

        def own_contact(explained: Floats) -> Floats:
            """Log-density (N,) of poses by their own contact: explained is (N, terms)."""
            return alone.runs.support(explained @ own)

        def all_of_it(explained: Floats) -> Floats:
            """Log-density (N,) that the samples are brought to."""
            return strictness * memory.runs.support(explained)

        samples = samples.copy()
        sd_m = np.sqrt(memory.variance[scan])
        samples[:, :2] += sd_m * rng.standard_normal((len(samples), 2))
        opinion = pf.equal(samples, memory.explain(samples))
        return injection.anneal(opinion, own_contact, all_of_it, memory.explain, rng, self._scale)

    def _merged(self, opinion: Belief) -> Belief:
        """The belief merged with a second opinion. Samples know nothing of how the object slides,
        so each takes the ground of the nearest particle."""
        belief = self.belief
        if belief.ground.size:
            apart = self.metric.distance(opinion.pose[:, None], belief.pose[None])
            opinion.ground = belief.ground.take(apart.argmin(axis=1), axis=0)
        runs, evidence = self.memory.runs, self._evidence
        return injection.merge(
            belief, evidence.of(belief, runs), opinion, evidence.of(opinion, runs)
        )

    def _become(self, belief: Belief, moves: int) -> None:
        """Resample to the number of equal particles that this width needs, and separate the
        copies."""
        self.belief = pf.resample(belief, self._size(belief), self._rng)
        support, room = self.memory.runs.support, self._room()
        for _ in range(moves):
            pf.rejuvenate(self.belief, self.memory.explain, support, self._rng, self._scale, room)

    def _room(self) -> pf.Room:
        """The circle that may hold the object: around the last touch, or around the table's middle.
        The sensor may have gone elsewhere since."""
        touch, config = self.memory.last_touch, self._config
        centre = np.array(config.centre_m) if touch is None else touch
        return pf.Room(centre, ROOM * config.half_width_m)

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

    def _keep_to_size(self) -> None:
        """Forget the scans that are too many: the oldest of the contact with the most scans,
        because further scans of one press tell little, and the oldest silent scans."""
        memory = self.memory
        kept = np.ones(len(memory), dtype=np.bool_)
        touched, silent = np.flatnonzero(memory.contact), np.flatnonzero(memory.silent)
        kept[silent[: max(len(silent) - SILENT_MAX, 0)]] = False
        for _ in range(len(touched) - REMEMBERED):
            touched = touched[kept[touched]]
            _, which, count = np.unique(
                memory.number[touched], return_inverse=True, return_counts=True
            )
            kept[touched[count[which].argmax()]] = False
        self._remember_only(kept)

    def _remember_only(self, kept: Bools) -> None:
        """Keep the scans in `kept` (K,); drop the rest."""
        if kept.all():
            return
        terms = np.full(self.memory.terms, True)
        self.memory.of_scans(terms)[:] = kept
        self.memory = self.memory.only(kept)
        self.belief.remembered = self.belief.remembered[:, terms]


def _log_mean(values: Floats) -> float:
    """Logarithm of the mean of exp(values)."""
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).mean()))
