"""The belief about one object: all that is remembered counts, and samples of a contact are weighed
by it."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.estimate import MODE_RADIUS_M, SURE, Place, placed
from taxeld.estimator.evidence import LEAST, UNTOUCHED, ModelEvidence, inherited, odds
from taxeld.estimator.memory import Memory, ObjectSkin, OffsetVariance
from taxeld.estimator.particles import Explained, Particles
from taxeld.estimator.priors import BeliefPrior, PriorDensity
from taxeld.estimator.scans import ScanEvidence, noise_of, surplus
from taxeld.model.observation import Lesson, Observation, ObservationModel
from taxeld.model.push import STRIDE, Push, assumed, changed, push
from taxeld.model.symmetry import PoseMetric
from taxeld.prior import PosePrior

Draw = Callable[[Observation, int], Poses]
"""Poses (≤ n, 3) in the world that explain a contact by itself; none of a silent scan."""

PENDING_MAX = 64  # scans that may wait to be learned
PUSHED_M = 2e-4  # m between two scans: a shorter way is a press that settles
ROOM = 3.0  # half-widths of the table around the last touch: the whole table, and more
TELLING = 1.0  # nats that a silent scan must cost some particle to be remembered
SCALES = np.array([0.0, 0.5, 1.0, 2.0])  # candidates of `OffsetVariance.scale`
EXPECTING = 32  # poses by which a belief says what it expects
FITTING = 32  # particles by which the variance of offsets is fitted, about
FITTED_NATS = 1.0  # nats of evidence needed to change it
SEARCHES = 2  # after a contact, at most
SEARCHED = 4  # contacts whose samples a search takes
MISSED = 0.02  # probability, until a search has found nothing else, that the belief has missed it
ADOPTED = 2  # contacts with whose samples an object begins that was ruled out before


class Confidence(IntEnum):
    """How sure a belief is, were its object the only one known."""

    UNSURE = 0
    SURE = 1  # but for what a search may find
    SEARCHED = 2  # and it has stayed so by a search or a touch


class ObjectBelief:
    """What is believed of one object: particles, the scans that they explain, and the scans that
    are yet to be learned."""

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
        is_pushed = config.motion != "none"
        offsets = OffsetVariance() if is_pushed else OffsetVariance(robot_m, config.nudge_m)
        self.memory = Memory(ObjectSkin.of(model, noise_of(config)), offsets)
        self.pending: deque[ScanEvidence] = deque(maxlen=PENDING_MAX)
        self.particles = pf.uniform(config, rng)
        self.metric = PoseMetric(model.scene)
        self.log_z = 0.0  # log evidence of all that is remembered, in relation to readings alone
        self.share = 1.0  # probability of its object among those that it may be
        self.push: Push = push
        self._evidence = ModelEvidence(model, self.metric)
        self._confidence = Confidence.UNSURE
        self._searches = 0  # since the last contact
        self.evidence, self._alone = UNTOUCHED, odds([UNTOUCHED])
        self._take_place(self._placed())

    def follow(self, before: Observation, after: Observation) -> None:
        """Move the particles with an object that is pushed from one scan to the next. A prior takes
        the place of the memory: its scans were taken where the object no longer is."""
        particles, metric = self.particles, self.metric
        if not particles.ground.size:
            particles.ground = assumed(len(particles), self._rng)
        model = self._model.links[after.link]
        pose, pushed = self.push(
            model,
            metric,
            particles.pose,
            particles.ground,
            before.sensor,
            after.sensor,
            float(after.z.max()) * model.depth_max_m,
            self._rng,
        )
        pushed_m = float(particles.weight @ pushed)
        if pushed_m < PUSHED_M:
            return
        particles.pose = pose
        strides = pushed_m / (STRIDE * self._model.scene.mean_radius)
        particles.ground = changed(particles.ground, strides, self._rng)
        self._take_place(self._placed())
        log_volume = self._evidence.log_volume
        earlier = BeliefPrior(metric, pose, particles.weight, self.place.modes, log_volume)
        self.memory, self.log_z = self.memory.anew(earlier), 0.0
        particles.explained = self.memory.explain(pose)

    def take(self, scan: ScanEvidence) -> tuple[int, float]:
        """Learn from a scan; → the number of samples injected, and the scan's log evidence."""
        samples = self._draw(scan.observation, self._wanted)
        particles, before, memory = self.particles, self.memory, self.memory.plus(scan, self.log_z)
        is_first = scan.number > before.newest  # of its contact
        # the object may have moved since the last contact, so what is remembered grows older
        if before.offsets.nudge_m and is_first:
            explained = memory.explain(particles.pose)
        else:
            known, newest = particles.explained, memory.explain_newest(particles.pose)
            if not scan.is_contact and scan.background - newest.min() < TELLING:
                return 0, 0.0
            explained = known._replace(scans=np.hstack([known.scans, newest]))
        self.memory = memory
        evidence = self._reweight(before, explained)
        if evidence is None:
            evidence = 0.0
            self._begin_anew(scan, samples)
        else:
            self._forget_surplus()
            if len(samples):
                self._searches = 0
                drawn = self._importance_samples(samples, len(self.memory) - 1)
                self._become(self._merged(drawn) if self._has_more or memory.priors else drawn)
                if is_first and self._fit_offsets():
                    self._become(self.particles)
            elif pf.resampling_is_due(particles):
                self._become(particles)
        # silence that the belief expected changes no verdict, and before a touch there is none
        is_felt = bool(self.memory.contact.any()) or self.memory.earlier is not None
        if len(samples) or (is_felt and abs(evidence) > 1.0 - SURE):
            self._judge(has_looked=len(samples) > 0 and not self._has_more)
        return len(samples), evidence

    def take_prior(self, pose: PosePrior, contacts: int) -> None:
        """Take a prior after contact number `contacts`."""
        log_volume = self._evidence.log_volume
        prior = PriorDensity(pose, self.metric, self._config, log_volume, contacts + 1)
        before, self.memory = self.memory, self.memory.with_prior(prior, self.log_z)
        if not before.contact.any() and before.earlier is None:
            self._believe(prior)
            return
        self._reweight(before, self.memory.explain(self.particles.pose))
        drawn = self._equal(prior.samples(max(self._wanted, 1), self._rng))
        drawn = self._weighed(drawn, drawn.explained.priors[:, -1])
        self._become(self._merged(drawn))
        self._searches, self._confidence = 0, Confidence.UNSURE
        self._judge(has_looked=False)

    def _believe(self, prior: PriorDensity) -> None:
        """Before the first touch: particles of the prior, and of the whole table."""
        n = max(round(prior.pose.weight * self._config.particles), 1)
        poses = pf.uniform(self._config, self._rng).pose
        poses[:n] = prior.samples(n, self._rng)
        self.particles = self._equal(poses)
        pf.reweight(self.particles, self.particles.explained.scans.sum(axis=1))
        self._take_place(self._placed())

    @property
    def is_open(self) -> bool:
        """Whether a search is due: once before the belief may be sure."""
        is_due = self._confidence is Confidence.SURE and self._has_more
        return is_due and self._searches < SEARCHES

    @property
    def _has_more(self) -> bool:
        """Whether more than one contact is remembered."""
        return int(np.count_nonzero(self.memory.contact)) > 1

    def search(self) -> int:
        """Merge the particles with samples of several remembered contacts; → how many."""
        contacts, found, wanted = np.flatnonzero(self.memory.contact), 0, self._wanted
        for scan in self._rng.permutation(contacts)[:SEARCHED].tolist():
            samples = self._draw(self.memory.scans[scan].remembered, wanted)
            if len(samples):
                self.particles = self._merged(self._importance_samples(samples, scan))
                found += len(samples)
        if not found:  # there is no time
            return 0
        self._searches += 1
        self._become(self.particles)
        self._judge(has_looked=True)
        return found

    def adopt(self, memory: Memory) -> int:
        """Begin with the scans that another object's `memory` has; → the number of samples used."""
        self.pending.clear()
        self.memory = self.memory.adopted(memory)
        self.particles = pf.uniform(self._config, self._rng)
        self._searches, self._confidence = 0, Confidence.UNSURE
        contacts, used = np.flatnonzero(self.memory.contact)[::-1], 0
        for scan in contacts[:: max(len(contacts) // ADOPTED, 1)][:ADOPTED].tolist():
            samples = self._draw(self.memory.scans[scan].remembered, self._config.injected)
            if len(samples):
                drawn = self._importance_samples(samples, scan)
                self._become(self._merged(drawn) if used else drawn)
                used += len(samples)
        if not used:
            self.particles = self._equal(self.particles.pose)
        self._judge(has_looked=False)
        return used

    def expected(self, after: int, link: int) -> Lesson | None:
        """The remembered contacts of a link after number `after`, and the depths that the belief
        expects of them; None where nothing is remembered."""
        memory = self.memory
        asked = memory.contact & (memory.number > after) & (memory.link == link)
        if not asked.any():
            return None
        drawn = pf.resample(self.particles, EXPECTING, np.random.default_rng(0))
        return memory.only(asked).contacts_at(drawn.pose, link)

    def _equal(self, poses: Poses) -> Particles:
        """Equally weighted poses (N, 3)."""
        return pf.equal(poses, self.memory.explain(poses))

    def _reweight(self, before: Memory, explained: Explained) -> float | None:
        """Reweight the particles by what the memory has more than the one `before`; → as
        `pf.reweight`."""
        particles = self.particles
        known = before.runs.support(particles.explained)
        particles.explained = explained
        return pf.reweight(particles, self.memory.runs.support(explained) - known)

    def _importance_samples(self, samples: Poses, scan: int) -> Particles:
        """Samples (S, 3) of scan number `scan`, weighed by the whole memory in place of that scan
        alone."""
        memory, off = self.memory, self._rng.standard_normal((len(samples), 2))
        samples = samples.copy()
        samples[:, :2] += np.sqrt(memory.variance[scan]) * off
        drawn = self._equal(samples)
        gained = drawn.explained.scans[:, scan] - memory.background[scan]
        return self._weighed(drawn, np.logaddexp(gained, LEAST))

    def _weighed(self, drawn: Particles, own: Floats) -> Particles:
        """Samples, drawn by a log-density `own` (S,), weighed and drawn anew by that of the
        memory."""
        drawn.log_weight = self.memory.runs.support(drawn.explained) - own
        pf.normalise(drawn)
        return pf.resample(drawn, len(drawn), self._rng)

    @property
    def _wanted(self) -> int:
        """Number of samples: as configured; in proportion more while the belief is wide or
        unlikely, but no more than it has particles."""
        config = self._config
        size = self._most if self._alone.hypotheses.stands < 0.5 else len(self.particles)
        return max(config.injected, min(round(config.injected * size / config.particles), size))

    def _judge(self, *, has_looked: bool) -> None:
        """Weigh the hypotheses, and find how sure the belief is. `has_looked`: whether samples of
        another contact were merged."""
        self.evidence = UNTOUCHED
        if len(self.memory):
            self.evidence = self._evidence.weighed(self.particles, self.memory.runs)
            self.log_z = self.evidence.log_z
        self._alone = odds([self.evidence])
        before, now, was = self.place, self._placed(), self._confidence
        is_sure = float(self._alone.here[0]) * now.within >= SURE
        apart = self.metric.distance(before.modes[0].pose, now.modes[0].pose)
        stays = was > Confidence.UNSURE and bool(apart < MODE_RADIUS_M * self.metric.scale)
        is_searched = stays and (has_looked or was is Confidence.SEARCHED)
        self._confidence = Confidence(is_sure * (1 + is_searched))
        self._take_place(now)

    def _placed(self) -> Place:
        """Where the particles have the object."""
        return placed(self.particles, self.metric, self._config)

    def _take_place(self, place: Place) -> None:
        """Keep the place, less the probability that no particle is where the object is."""
        found = 1.0 if self._confidence is Confidence.SEARCHED else 1.0 - MISSED
        self.place = replace(place, within=found * place.within)

    def _fit_offsets(self) -> bool:
        """Fit the variance of offsets to the evidence: contacts that agree exactly are believed
        exactly, others get more room. Each contact moves it by one step; → whether it does."""
        memory, particles = self.memory, self.particles
        now = memory.offsets
        if not (now.robot_m or now.nudge_m):
            return False
        at = int(np.flatnonzero(now.scale == SCALES)[0])
        others = [scale for scale in SCALES[max(at - 1, 0) : at + 2].tolist() if scale != now.scale]
        tried = [replace(memory, offsets=replace(now, scale=scale)) for scale in others]
        support, some = memory.runs.support, slice(None, None, max(len(particles) // FITTING, 1))
        known = support(particles.explained)
        gains = [support(each.explain(particles.pose[some])) - known[some] for each in tried]
        gained = [pf.log_sum_exp(gain) - np.log(len(gain)) for gain in gains]
        best = int(np.argmax(gained))
        is_better = gained[best] > FITTED_NATS
        if is_better:
            self.memory = tried[best]
            self._reweight(memory, self.memory.explain(particles.pose))
        return bool(is_better)

    def _begin_anew(self, scan: ScanEvidence, samples: Poses) -> None:
        """Begin with the samples (S, 3) of a contact, or with poses everywhere."""
        self.memory, self.log_z = self.memory.anew(), 0.0
        self.particles = pf.uniform(self._config, self._rng)
        if len(samples):
            self.memory = self.memory.plus(scan, self.log_z)
            self._become(self._equal(samples))

    def _merged(self, drawn: Particles) -> Particles:
        """The particles merged with importance samples. These know nothing of how the object
        slides, so each takes the ground of a particle."""
        particles = self.particles
        if particles.ground.size:
            drawn.ground = pf.resample(particles, len(drawn), self._rng).ground
        runs, of = self.memory.runs, self._evidence.of
        return pf.merge(particles, of(particles, runs), drawn, of(drawn, runs))

    def _become(self, particles: Particles) -> None:
        """Resample to the number of equal particles that this width needs, and separate the
        copies by a move."""
        self.particles = pf.resample(particles, self._size(particles), self._rng)
        memory, touch = self.memory, self.memory.last_touch
        # around the last touch, as the sensor may have gone elsewhere since
        centre = np.array(self._config.centre_m) if touch is None else touch
        room = pf.Room(centre, ROOM * self._config.half_width_m)
        by = memory.runs.support
        pf.rejuvenate(self.particles, memory.explain, by, self._rng, self.metric.scale, room)

    def _size(self, particles: Particles) -> int:
        config = self._config
        if self._most <= config.particles:
            return config.particles
        drawn = pf.resample(particles, config.particles, self._rng)
        cell = pf.CELL * [self.metric.scale, self.metric.scale, 1.0]
        wanted = pf.enough(pf.occupied(self.metric.reduced(drawn.pose), cell))
        return min(max(wanted, config.particles), self._most)

    @property
    def _most(self) -> int:
        """Particles at most: an unlikely object takes fewer."""
        return max(round(self.share * self._config.particles_max), self._config.particles)

    def _forget_surplus(self) -> None:
        """Forget the scan that is too many. What it told counts on: had the object to be found
        anew by the scans that are left, it would seem to have moved."""
        memory, particles, forgotten = self.memory, self.particles, surplus(self.memory.scans)
        if forgotten is None:
            return
        kept = np.arange(len(memory)) != forgotten
        known, fewer = particles.explained, memory.only(kept)
        explained = known._replace(scans=known.scans[:, kept])
        gained = inherited(particles, memory.runs, fewer.runs, explained)
        self.memory, self.log_z = fewer.after_loss(gained), self.log_z - float(gained[0])
        particles.explained = explained
