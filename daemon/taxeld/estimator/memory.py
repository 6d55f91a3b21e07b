"""Memory of past scans: how well a pose explains which taxels were pressed before, and which not.

A sample proposed for one contact takes no other into account, and a moved particle must still
explain them all (after the memory unscented particle filter, Vezzani et al. 2017). Silent scans are
remembered beside contacts: where the skin met nothing, the object is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Grid, Poses
from taxeld.estimator.compiled import Explainer, explainer
from taxeld.estimator.evidence import HAZARD, SWAPPED, Runs
from taxeld.estimator.likelihood import Explain, NumpyExplainer
from taxeld.estimator.particles import Explained
from taxeld.estimator.priors import BeliefPrior, PriorDensity
from taxeld.estimator.scans import Field, ScanEvidence, fields_of
from taxeld.model.noise import Noise
from taxeld.model.observation import Lesson, Observation, ObservationModel
from taxeld.model.response import LEAST_RATE, sagging


@dataclass(frozen=True, slots=True)
class OffsetVariance:
    """Of the offsets by which remembered scans may be off, in the plane."""

    robot_m: float = 0.0  # sd of the sensor's reported place, one draw for a whole contact
    nudge_m: float = 0.0  # sd of the object's motion at each later contact
    scale: float = 1.0  # factor on both, fitted to the contacts

    def of(self, age: NDArray[np.intp]) -> Floats:
        """Of scans with `age` (K,) later contacts → (K,) [m²]."""
        return np.asarray(self.scale**2 * (self.robot_m**2 + self.nudge_m**2 * age))


@dataclass(frozen=True, slots=True)
class ObjectSkin:
    """An object on the skin of each link, and how readings err where a scan does not say."""

    links: Sequence[ObservationModel]
    noise: Noise
    explainers: Sequence[Explainer]

    @classmethod
    def of(cls, model: ObservationModel, noise: Noise) -> "ObjectSkin":
        return cls(model.links, noise, [explainer(each, noise) for each in model.links])

    def column(self, scan: ScanEvidence) -> Grid:
        """A scan as its link's explainer takes it."""
        return self.explainers[scan.observation.link].column(scan.fields)


@dataclass(frozen=True, eq=False)
class Memory:
    """K scans to be explained by poses of the object in the world, and priors. It never changes:
    what is learned makes another one."""

    skin: ObjectSkin
    offsets: OffsetVariance = OffsetVariance()
    earlier: BeliefPrior | None = None  # what was known before the first scan
    prior: PriorDensity | None = None  # that was given
    scans: Sequence[ScanEvidence] = ()
    columns: Sequence[Grid] = ()  # of the scans, as the explainers lay them out
    newest: int = 0  # number of the newest contact
    before: dict[int, float] = field(default_factory=dict)  # log evidence of all before a step
    # log probability that the object moved before a step, where it is not the usual
    moves: dict[int, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.scans)

    @property
    def priors(self) -> list[BeliefPrior | PriorDensity]:
        """The P priors."""
        return [each for each in (self.earlier, self.prior) if each is not None]

    @cached_property
    def contact(self) -> Bools:
        """(K,) whether any taxel was pressed."""
        return np.array([scan.is_contact for scan in self.scans], np.bool_)

    @cached_property
    def number(self) -> NDArray[np.intp]:
        """(K,) contact; the last one if silent."""
        return np.array([scan.number for scan in self.scans], np.intp)

    @cached_property
    def link(self) -> NDArray[np.intp]:
        """(K,) whose skin it is."""
        return np.array([scan.observation.link for scan in self.scans], np.intp)

    @cached_property
    def sensor(self) -> Poses:
        """(K, 3) sensor's poses in the world."""
        return np.array([scan.observation.sensor for scan in self.scans]).reshape(-1, 3)

    @cached_property
    def variance(self) -> Floats:
        """(K,) variance of each scan's offset [m²]."""
        place_m2 = np.array([scan.observation.place_sd_m**2 for scan in self.scans])
        return np.asarray(self.offsets.of(self.newest - self.number) + place_m2)

    @cached_property
    def background(self) -> Floats:
        """(K,) log p(scan | whatever was pressed, or nothing)."""
        return np.array([scan.background for scan in self.scans])

    @cached_property
    def _untouched(self) -> Floats:
        return np.array([scan.untouched for scan in self.scans])

    @property
    def last_touch(self) -> Floats | None:
        """(2,) the sensor's place in the world at the newest contact; None without a contact."""
        touches = np.flatnonzero(self.contact)
        return np.asarray(self.sensor[touches[-1], :2]) if len(touches) else None

    @property
    def share(self) -> Floats:
        """(K,) share of each scan in its contact, so that a contact counts once, however many scans
        it has; 1 for a silent one."""
        share, touched = np.ones(len(self)), self.contact
        _, which, count = np.unique(self.number[touched], return_inverse=True, return_counts=True)
        share[touched] = 1.0 / count[which]
        return share

    @cached_property
    def runs(self) -> Runs:
        """The runs of the remembered scans."""
        prior, is_known = self.prior, self.earlier is not None
        of_all = [scan.step for scan in self.scans] + ([] if prior is None else [prior.step])
        steps, which = np.unique(np.array(of_all, np.intp), return_inverse=True)
        k, r = len(self), len(steps)
        shares, of_priors = np.zeros((k, 2 * r)), np.zeros((len(self.priors), 2 * r))
        of_priors[: int(is_known), r : r + 1] = 1.0  # what was known before is of the first step
        of_priors[int(is_known) :, r + which[k:]] = 1.0
        which = which[:k]
        shares[np.arange(k), which + r * ~self.contact] = self.share
        touched = np.zeros(r, np.bool_)
        touched[which[self.contact]] = True
        usually = float(np.log(HAZARD))
        moves = [self.moves.get(step, usually) for step in steps.tolist()]
        begun = np.array([self.before[step] for step in steps.tolist()])
        begun += np.array(moves) - begun[:1]
        begun[:1] = 0.0  # evidence is of the remembered scans alone
        opens = touched.copy()
        opens[:1] = True
        if prior is not None:
            at = int(np.searchsorted(steps, prior.step))
            if not touched[at]:  # evidence is in relation to poses that touch, and none did yet
                opens[at] = True
                begun[at] -= (at > 0) * prior.log_untouched
        background, opened = self.background @ shares, np.where(opens, begun, -np.inf)
        return Runs(steps, shares, of_priors, background, touched, begun, opened, is_known)

    def plus(self, scan: ScanEvidence, log_z: float = 0.0) -> "Memory":
        """A memory of one scan more. `log_z`: log evidence of all that is remembered so far."""
        return replace(
            self,
            scans=(*self.scans, scan),
            columns=(*self.columns, self.skin.column(scan)),
            newest=max(self.newest, scan.number),
            before={scan.step: log_z} | self.before,
        )

    def with_prior(self, prior: PriorDensity, log_z: float) -> "Memory":
        """The same with a prior in place of the one that was given before. `log_z`: as of
        `plus`."""
        return replace(self, prior=prior, before={prior.step: log_z} | self.before)

    def only(self, kept: Bools) -> "Memory":
        """A memory of the scans in the mask `kept` (K,)."""
        scans, columns = tuple(compress(self.scans, kept)), tuple(compress(self.columns, kept))
        steps = {scan.step for scan in scans} | ({self.prior.step} if self.prior else set())
        before = {step: self.before[step] for step in steps}
        return replace(self, scans=scans, columns=columns, before=before)

    def after_loss(self, gained: Floats) -> "Memory":
        """The same with evidence of all before each step that is larger by `gained` (R,) nats, in
        relation to the first."""
        steps = self.runs.step.tolist()
        first = self.before[steps[0]] + gained[0]
        before = {
            k: self.before[k] + float(by - first) for k, by in zip(steps, gained, strict=True)
        }
        return replace(self, before=before)

    def anew(self, earlier: BeliefPrior | None = None) -> "Memory":
        """An empty memory with the same variance of offsets, and with what was known before."""
        return Memory(self.skin, self.offsets, earlier)

    def adopted(self, other: "Memory") -> "Memory":
        """A memory for this object of the scans and the variance that another object's has."""
        first, prior, before = min(other.before, default=0), self.prior, dict[int, float]()
        if prior is not None:
            before[prior.step] = other.before.get(prior.step, 0.0)
        before |= {k: z + SWAPPED * (k > first) for k, z in other.before.items()}
        columns = tuple(map(self.skin.column, other.scans))
        made = replace(other, skin=self.skin, columns=columns, before=before)
        return replace(made, earlier=None, prior=prior)

    def explain(self, poses: Poses) -> Explained:
        """How well poses (N, 3) explain the scans and the priors."""
        met = np.empty((len(poses), len(self)))
        for at, explain in self._explained:
            met[:, at] = explain(poses)
        met += self._untouched
        known = [each.log_density(poses) for each in self.priors]
        return Explained(met, np.array(known).reshape(len(known), len(poses)).T)

    def explain_newest(self, poses: Poses) -> Floats:
        """log p(scan | pose) of the newest scan: poses (N, 3) → (N, 1)."""
        scans, columns = self.scans[-1:], self.columns[-1:]
        alone = replace(self, scans=scans, columns=columns, earlier=None, prior=None)
        return alone.explain(poses).scans

    @cached_property
    def _explained(self) -> list[tuple[NDArray[np.intp], Explain]]:
        """The scans' numbers on each link that has any, and what explains them."""
        links = [(link, np.flatnonzero(self.link == link)) for link in range(len(self.skin.links))]
        return [(at, self._explainer(link, at)) for link, at in links if len(at)]

    def _explainer(self, link: int, at: NDArray[np.intp]) -> Explain:
        """Explains the scans number `at` of a link."""
        columns, silent = [self.columns[k] for k in at.tolist()], ~self.contact[at]
        return self.skin.explainers[link].of(columns, self.sensor[at], self.variance[at], silent)

    def foreseen(self, like: Observation, z: Floats, sensor: Poses, poses: Poses) -> Floats:
        """log p(scan | pose) of scans that may come: activations z (S, M) at the sensor's poses (S,
        3), of a skin in the state in which it was at `like`, and poses (N, 3) → (N, S)."""
        fields = fields_of(z, like, like.noise or self.skin.noise)
        variance = np.full(len(z), self.offsets.of(np.zeros(1, np.intp))[0])
        explainer = self.skin.explainers[like.link]
        columns = list(map(explainer.column, np.moveaxis(fields, 1, 0)))
        explain = explainer.of(columns, sensor, variance, z.max(axis=1) <= 0.0)
        return np.asarray(explain(poses) + fields[Field.SILENT].sum(axis=1, dtype=np.float64))

    def contacts_at(self, poses: Poses, link: int = 0) -> Lesson:
        """The remembered contacts, all of one link, and the depths expected of an object at equally
        likely poses (N, 3)."""
        model = self.skin.links[link]
        scans, n, taxels = np.flatnonzero(self.contact), len(poses), len(model.layout)
        fields = np.stack([self.scans[k].fields for k in scans.tolist()], axis=1)
        contacts = self.sensor[scans], self.variance[scans], ~self.contact[scans]
        touches = NumpyExplainer(model, self.skin.noise).touches(fields, *contacts, poses)
        near, told = touches.near(np.arange(len(scans) * n), touches.top().offset)
        at, depth = near.row // n * taxels + near.taxel, near.depth
        rate = np.maximum(near.along * told[Field.SAG], LEAST_RATE)
        found = np.minimum(sagging(depth, rate), 1.0)

        def mean(values: Grid) -> Floats:
            total = np.bincount(at, values, len(scans) * taxels)
            return np.asarray(total.reshape(len(scans), taxels) / n)

        h, square = mean(found), mean(found * found)
        by_sag = mean(found * np.maximum(1.0 - depth / rate, 0.0))
        z, live = fields[Field.Z].astype(np.float64), fields[Field.ROOT] > 0.0
        floors = [np.broadcast_to(self.scans[k].observation.floor, taxels) for k in scans.tolist()]
        added = square - h * h + fields[Field.RESIDUE] ** 2
        return Lesson(z, np.stack(floors), h, by_sag, added, live, self.share[scans])
