"""The rule that remembers: samples are merged with the belief by their evidence, and the past is
dropped when the object has moved."""

from dataclasses import replace

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import consistency, injection
from taxeld.estimator import particles as pf
from taxeld.estimator.confidence import Confidence, firm, is_firm
from taxeld.estimator.memory import Memory, Prior, Slack
from taxeld.estimator.particles import Belief
from taxeld.estimator.push import STRIDE, Push, assumed, changed, push
from taxeld.estimator.rule import PUSHED_M, Draw, EstimatorCounters, anew, drawn, noise_of
from taxeld.model.observation import Observation, ObservationModel

ROOM = 3.0  # half-widths of the table around the last touch: the whole table, and more
MOVES = 2  # Metropolis steps a contact
REMEMBERED = 16  # scans of touches remembered at most
SILENT_MAX = 32  # silent scans remembered at most
TELLING = 1.0  # nats of range over the particles; a less telling silent scan is not remembered
KLD_ERROR = 0.05  # nats between a wide belief and its particles
KLD_CONFIDENCE = 0.99  # probability of no more than KLD_ERROR
SCALES = np.array([0.0, 0.5, 1.0, 2.0])  # candidate factors on the configured slack
SLACK_FROM = 3  # contacts: fewer agree with any slack
SLACK_PARTICLES = 32  # particles that estimate the evidence of a slack
SLACK_NATS = 1.0  # nats of evidence needed to change the slack
REVISITS = 4  # second opinions after a contact, while there is nothing to learn


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
        self.confidence = Confidence.of(self.belief, model.scene)
        self._scale = self.confidence.metric.scale
        self.counters = EstimatorCounters()
        self.push: Push = push
        self._revisits = 0  # second opinions since the last contact
        self._fitted = 0  # number of the contact after which the slack was fitted

    def follow(self, before: Observation, after: Observation) -> None:
        """Replace the memory by a prior: its scans were taken where the object no longer is."""
        belief, metric = self.belief, self.confidence.metric
        if not belief.ground.size:
            belief.ground = assumed(len(belief), self._rng)
        pose, pushed = self.push(
            self._model,
            metric,
            belief.pose,
            belief.ground,
            before.sensor,
            after.sensor,
            float(after.z.max()) * self._model.depth_max_m,
            self._rng,
        )
        pushed_m = float(belief.weight @ pushed)
        if pushed_m < PUSHED_M:
            return
        belief.pose = pose
        strides = pushed_m / (STRIDE * self._model.scene.mean_radius)
        belief.ground = changed(belief.ground, strides, self._rng)
        self.confidence.moved(belief)
        prior = Prior(metric, pose, belief.weight, self.confidence.summary.modes)
        self.memory = self.memory.anew(prior)
        belief.remembered = self.memory.explain(pose)

    def learn(self, observation: Observation, contacts: int, draw: Draw) -> tuple[int, float]:
        in_doubt = self.confidence.doubt
        samples = drawn(draw, observation, self._wanted())
        log_evidence = self._update(observation, samples, contacts)
        if log_evidence is None:
            return 0, 0.0
        contact, memory = firm(observation, contacts), self.memory
        self.confidence.learned(
            self.belief,
            len(samples),
            contact,
            memory.contacts,
            memory.oldest,
            in_doubt=in_doubt,
            known=memory.prior is not None,
        )
        return len(samples), log_evidence

    def _update(self, observation: Observation, samples: Poses, number: int) -> float | None:
        """Learn from a scan of contact `number`, or a silent scan after it, and from `samples` (S,
        3) of that scan, without judging the result; → log evidence, None where nothing was
        learned."""
        self._age(number)
        before = self.memory.share
        self.memory.add(observation, number)
        newest = self.memory.explain_newest(self.belief.pose)
        if not observation.is_contact and self._is_expected(newest):
            self.memory = self.memory.only(np.arange(len(self.memory)) < len(self.memory) - 1)
            self.confidence.doubt = False
            return None
        remembered = np.column_stack([self.belief.remembered, newest])
        evidence = pf.reweight(
            self.belief, remembered @ self.memory.share - self.belief.remembered @ before
        )
        if evidence is None:
            self._begin_anew(observation, samples, number)
            return 0.0
        self.belief.remembered = remembered
        self._weigh(samples)
        return evidence

    def _is_expected(self, newest: Floats) -> bool:
        """Whether a silent scan of log-likelihoods `newest` (N,) neither separates the particles
        nor refutes any."""
        refuting = self.memory.ceiling[-1] - newest.min() > consistency.MOST
        lost = not np.isfinite(self.belief.log_weight.max())  # no particle is possible
        return not (refuting or lost) and bool(np.ptp(newest) < TELLING)

    def _age(self, number: int) -> None:
        """Let the remembered scans age when a contact begins, as the object may have moved."""
        memory, belief = self.memory, self.belief
        nudge_m = memory.slack.nudge_m * memory.slack.scale
        if not nudge_m or not len(memory) or number <= memory.newest:
            return
        memory.newest = number
        step = nudge_m * self._rng.standard_normal((len(belief), 3))
        step[:, 2] /= max(self.confidence.metric.arm_m, nudge_m)
        belief.pose = belief.pose + step
        belief.remembered = memory.explain(belief.pose)

    @property
    def is_open(self) -> bool:
        confidence = self.confidence
        is_settled = confidence.is_searched and not confidence.doubt
        few = self._revisits < REVISITS and not is_settled
        return few and int(np.count_nonzero(self.memory.contact)) > 1

    def revisit(self, draw: Draw) -> int:
        """Take a second opinion: samples of a remembered contact, brought to explain all
        contacts."""
        if not self.is_open:
            return 0
        memory, confidence = self.memory, self.confidence
        contacts = np.flatnonzero(memory.contact)
        scan = int(self._rng.choice(contacts))
        samples = drawn(draw, memory.scan(scan), self._wanted())
        if not len(samples):  # none were asked for, or there is no time
            return 0
        self._revisits += 1
        opinion = self._opinion(samples, memory, scan)
        merged = self._merged(opinion)
        self._become(merged, moves=1)
        excess = consistency.excess(memory, self.belief)
        newest = contacts[-1]
        confidence.doubt = bool(excess[newest] > 0.0) or consistency.is_excessive(
            memory, self.belief
        )
        confidence.revisited(self.belief, len(samples))
        return len(samples)

    def _wanted(self) -> int:
        """Number of samples: as configured, and more while the belief is wide or in doubt."""
        config = self._config
        size = config.particles_max if self.confidence.doubted else len(self.belief)
        return round(config.injected * max(size / config.particles, 1.0))

    def _weigh(self, samples: Poses) -> None:
        """Judge the newest scan, already in the weights, and move the particles. `samples` is (S,
        3)."""
        confidence = self.confidence
        confidence.doubt = bool(consistency.excess(self.memory, self.belief)[-1] > 0.0)
        self._keep_to_size()
        if len(samples):
            self._take(samples)
            self._reconsider(samples)
            self._fit_slack()
        elif pf.resampling_is_due(self.belief):
            self._become(self.belief, moves=1)

    def _fit_slack(self) -> None:
        """Fit the slack to the evidence: contacts that agree exactly are believed exactly, others
        get more room. Each contact moves the slack by one step."""
        memory, belief = self.memory, self.belief
        now = memory.slack
        if memory.newest == self._fitted or memory.contacts < SLACK_FROM:
            return
        if not (now.robot_m or now.nudge_m):
            return
        self._fitted = memory.newest
        share = memory.share
        some = slice(None, None, -(-len(belief) // SLACK_PARTICLES))
        pose, support = belief.pose[some], belief.remembered[some] @ share
        at = int(np.flatnonzero(now.scale == SCALES)[0])
        gained = {}
        for scale in SCALES[max(at - 1, 0) : at + 2].tolist():
            if scale != now.scale:
                memory.slack = replace(now, scale=scale)
                gained[memory.slack] = _log_mean(memory.explain(pose) @ share - support)
        likeliest = max(gained, key=gained.__getitem__)
        memory.slack = likeliest if gained[likeliest] > SLACK_NATS else now
        if memory.slack is not now:
            remembered = memory.explain(belief.pose)
            pf.reweight(belief, (remembered - belief.remembered) @ share)
            belief.remembered = remembered
            self._become(belief, moves=1)

    def _begin_anew(self, observation: Observation, samples: Poses, number: int) -> None:
        """Begin with the samples (S, 3) of a contact, or with a uniform belief."""
        self.memory = self.memory.anew()
        self.belief = anew(self._config, self._rng)
        if len(samples):
            self.memory.add(observation, number)
            opinion = pf.equal(samples, self.memory.explain(samples))
            self._become(opinion, moves=MOVES)

    def _take(self, samples: Poses) -> None:
        """Merge the samples' (S, 3) opinion of the whole memory with the belief."""
        self._revisits = 0
        memory = self.memory
        opinion = self._opinion(samples, memory, len(memory) - 1)
        if np.count_nonzero(memory.contact) > 1 or memory.prior is not None:
            opinion = self._merged(opinion)
        self._become(opinion, moves=MOVES)

    def _opinion(self, samples: Poses, memory: Memory, scan: int) -> Belief:
        """Samples (S, 3) of scan number `scan`, brought to explain the whole memory."""
        own = np.zeros(memory.terms)
        memory.of_scans(own)[scan] = 1.0
        samples = samples.copy()
        samples[:, :2] += memory.slack_m(scan) * self._rng.standard_normal((len(samples), 2))
        opinion = pf.equal(samples, memory.explain(samples))
        return injection.anneal(opinion, own, memory.share, memory.explain, self._rng, self._scale)

    def _merged(self, opinion: Belief) -> Belief:
        """The belief merged with a second opinion. Samples know nothing of how the object slides,
        so each takes the ground of the nearest particle."""
        belief, metric = self.belief, self.confidence.metric
        if belief.ground.size:
            apart = metric.distance(opinion.pose[:, None], belief.pose[None])
            opinion.ground = belief.ground.take(apart.argmin(axis=1), axis=0)
        return injection.merge(belief, opinion, self.memory.share, self._scale)

    def _become(self, belief: Belief, moves: int) -> None:
        """Resample to the number of equal particles that this width needs, and separate the
        copies."""
        self.belief = pf.resample(belief, self._size(belief), self._rng)
        share, room = self.memory.share, self._room()
        for _ in range(moves):
            pf.rejuvenate(self.belief, self.memory.explain, share, self._rng, self._scale, room)

    def _room(self) -> pf.Room:
        """The circle that may hold the object: around the last touch, or around the table's middle.
        The sensor may have gone elsewhere since."""
        touch, config = self.memory.last_touch, self._config
        centre = np.array(config.centre_m) if touch is None else touch
        return pf.Room(centre, ROOM * config.half_width_m)

    def _size(self, belief: Belief) -> int:
        config = self._config
        if config.particles_max <= config.particles:
            return config.particles
        drawn = pf.resample(belief, config.particles, self._rng)
        wanted = pf.enough(
            pf.occupied(drawn.pose, pf.CELL * [self._scale, self._scale, 1.0]),
            KLD_ERROR,
            KLD_CONFIDENCE,
        )
        return min(max(wanted, config.particles), config.particles_max)

    def _reconsider(self, samples: Poses) -> None:
        """After a contact: drop the past that it has refuted.

        One contact that no pose explains may be a fault. Two in a row that some pose explains, if
        only the past were not, show that the object has moved.
        """
        confidence, memory = self.confidence, self.memory
        excess = consistency.excess(memory, self.belief)
        explained = bool(excess[-1] <= 0.0)
        if explained:
            prior = not consistency.refutes_prior(memory, self.belief)
            kept = excess <= 0.0
            if not (prior and kept.all()):
                confidence.contradicted(memory.newest, consistency.contradictions(memory, kept))
            self._remember_only(kept, prior=prior)
        doubt = not explained or consistency.is_excessive(self.memory, self.belief)
        confidence.judged(doubt=doubt, is_firm=is_firm(self.memory.scan(len(self.memory) - 1)))
        if not confidence.doubt:
            return
        doubted, contacts = confidence.doubted, np.flatnonzero(self.memory.contact)
        for last in dict.fromkeys((doubted, 2)):  # contacts in doubt, then the last two
            if not 2 <= last <= min(doubted, len(contacts)):
                continue
            kept = np.arange(len(self.memory)) >= contacts[-last]
            if self._begin_with(kept, samples):
                return

    def _begin_with(self, kept: Bools, samples: Poses) -> bool:
        """Begin anew from the scans `kept` (K,) if some pose explains all of them and the belief
        explains them far worse; → whether that was done. Everything else is then forgotten."""
        recent = self.memory.only(kept, prior=False)
        opinion = self._opinion(samples, recent, len(recent) - 1)
        if consistency.excess(recent, opinion).max() > 0.0:
            return False
        if consistency.is_excessive(recent, opinion):
            return False
        lost = consistency.deviance(self.memory, self.belief)[kept] - consistency.deviance(
            recent, opinion
        )
        # a few contacts fit more poses than all contacts do, so the gain must be large
        if lost.sum() <= consistency.MOST * np.count_nonzero(recent.contact):
            return False
        self.counters.forgotten += 1
        self.memory = recent
        self._become(opinion, moves=MOVES)
        self.confidence.contradicted(recent.newest, 1)
        self.confidence.judged(doubt=False)
        return True

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

    def _remember_only(self, kept: Bools, *, prior: bool = True) -> None:
        """Keep the scans in `kept` (K,), and the prior if `prior`; drop the rest."""
        if kept.all() and prior:
            return
        terms = np.full(self.memory.terms, prior)
        self.memory.of_scans(terms)[:] = kept
        self.memory = self.memory.only(kept, prior=prior)
        self.belief.remembered = self.belief.remembered[:, terms]


def _log_mean(values: Floats) -> float:
    """Logarithm of the mean of exp(values)."""
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).mean()))
