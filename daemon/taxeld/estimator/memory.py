"""Memory of past scans: how well a pose explains which taxels were pressed before, and which not.

A sample proposed for one contact takes no other into account, and a moved particle must still
explain them all (after the memory unscented particle filter, Vezzani et al. 2017). Silent scans are
remembered beside contacts: where the skin met nothing, the object is not.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Grid, Index, Poses
from taxeld.estimator.compiled import Scans, compiled
from taxeld.estimator.offsets import HIDDEN, Readings
from taxeld.estimator.prior_term import PriorTerm
from taxeld.estimator.reader import Kept, Reader, fields
from taxeld.estimator.runs import HAZARD, SWAPPED, Runs
from taxeld.model.noise import Noise
from taxeld.model.observation import Lesson, Nearby, Observation, ObservationModel
from taxeld.model.response import LEAST_RATE, sagging
from taxeld.model.symmetry import Mode, PoseMetric

Number = TypeVar("Number", np.intp, np.float64)

LEAST_SD = np.array([5e-4, 5e-4, 5e-3])  # m, m, rad: least sd of a prior's mode
SCANS = ("_sensor", "_place_m2", "link", "number", "pressed", "anything", "_untouched")  # (K, …)
FLOOR = np.exp(-14.0)  # share of a prior's peak density everywhere: lets the prior be refuted


class Pressed(NamedTuple):
    """Depths (P,) that taxels about a press read, at the best offset of each row."""

    h: Grid  # share of full scale
    more: Grid  # how much more they read where the cover sags one sd farther
    by_sag: Grid  # slope of h over the logarithm of the sag's length
    added: Floats  # (rows,) what the integral over the offset adds to the log-likelihood


@dataclass(frozen=True, slots=True)
class Slack:
    """How far a remembered scan may be off, in the plane."""

    robot_m: float = 0.0  # sd of the sensor's reported place, one draw for a whole contact
    nudge_m: float = 0.0  # sd of the object's motion at each later contact
    scale: float = 1.0  # factor on both, fitted to the contacts

    def variance(self, age: NDArray[np.intp]) -> Floats:
        """Variance [m²] of scans with `age` (K,) later contacts → (K,)."""
        return np.asarray(self.scale**2 * (self.robot_m**2 + self.nudge_m**2 * age))


class Prior:
    """An earlier belief in few numbers: a density over poses, up to the object's symmetry, as a sum
    of a Gaussian for each mode."""

    def __init__(
        self,
        metric: PoseMetric,
        poses: Poses,
        weight: Floats,
        modes: Sequence[Mode],
        log_volume: float = 0.0,
    ) -> None:
        """From a belief of poses (N, 3) with weights (N,), and its modes. Densities are relative to
        a uniform one over a volume of logarithm `log_volume`."""
        self._metric = metric
        self._modes = []
        for mode in modes:
            mean, cov = metric.mean(poses[mode.members], weight[mode.members], mode.pose)
            inverse = np.linalg.inv(cov + np.diag(LEAST_SD**2))
            height = float(np.log(mode.weight) + 0.5 * np.linalg.slogdet(inverse)[1])
            height += log_volume - 1.5 * float(np.log(2.0 * np.pi))
            self._modes.append((mean, inverse, height))
        self.ceiling = max(height for *_, height in self._modes)

    def log_density(self, poses: Poses) -> Floats:
        """Log-density of poses (N, 3) → (N,), up to a constant; about `ceiling` at most."""
        total = np.full(len(poses), FLOOR)
        for mean, inverse, height in self._modes:
            shift = self._metric.centres(poses) - self._metric.centres(mean)
            off = np.column_stack([shift, self._metric.turn(poses[:, 2], mean[2])])
            square = np.einsum("ni,ij,nj->n", off, inverse, off)
            total += np.exp(height - self.ceiling - 0.5 * square)
        return np.asarray(np.log(total) + self.ceiling)


class Memory:
    """K scans to be explained by poses of the object in the world, and a prior for everything known
    before them, if there is one."""

    def __init__(
        self,
        model: ObservationModel,
        noise: Noise,
        prior: Prior | None = None,
        slack: Slack | None = None,
    ) -> None:
        self._links = model.links
        self._noise = noise
        self.slack = slack or Slack()
        self._compiled = [compiled(each, noise) for each in model.links]
        # of each link; the same for all objects
        self.readers = [Reader(each, noise) for each in model.links]
        self._forget(prior)

    def _forget(self, prior: Prior | None) -> None:
        self.prior = prior
        self.term: PriorTerm | None = None  # a prior that was given
        self._sensor = np.empty((0, 3))
        self._place_m2 = np.empty(0)  # (K,) variance of each scan's own place [m²]
        taxels = max(len(each.layout) for each in self._links)
        self._kept: Grid = np.empty((len(Kept), 0, taxels), np.float32)
        self.link = np.empty(0, dtype=np.intp)  # (K,)
        self.number = np.empty(0, dtype=np.intp)  # (K,) contact; the last one if silent
        self.newest = 0  # number of the newest contact
        self.pressed = np.empty(0, dtype=np.intp)  # (K,) number of pressed taxels
        self.anything = np.empty(0)  # (K,) log p(scan | whatever was pressed, or nothing)
        self._untouched = np.empty(0)
        self.before: dict[int, float] = {}  # log evidence of all before a step
        # log probability that the object moved before a step, where it is not the usual
        self.moves: dict[int, float] = {}
        self._runs: Runs | None = None  # cached `runs`
        self._for_c: tuple[tuple[int, int, Slack], dict[int, Scans]] | None = None

    def __len__(self) -> int:
        return len(self._sensor)

    @property
    def terms(self) -> int:
        """Columns of `explain`: of the prior, of the given one, if there are, and of scans."""
        return len(self) + (self.term is not None) + (self.prior is not None)

    @property
    def contact(self) -> Bools:
        """(K,) whether any taxel was pressed."""
        return np.asarray(self.pressed > 0)

    @property
    def silent(self) -> Bools:
        """(K,) whether no taxel was pressed."""
        return np.asarray(self.pressed == 0)

    @property
    def last_touch(self) -> Floats | None:
        """(2,) the sensor's place in the world at the newest contact; None without a contact."""
        touches = np.flatnonzero(self.contact)
        return self._sensor[touches[-1], :2] if len(touches) else None

    @property
    def share(self) -> Floats:
        """(K,) share of each scan in its contact, so that a contact counts once, however many scans
        it has; 1 for a silent one."""
        share, touched = np.ones(len(self)), self.contact
        _, which, count = np.unique(self.number[touched], return_inverse=True, return_counts=True)
        share[touched] = 1.0 / count[which]
        return share

    @property
    def runs(self) -> Runs:
        """The runs of the remembered scans."""
        if self._runs is None:
            self._runs = self._in_steps()
        return self._runs

    def _in_steps(self) -> Runs:
        """A silent scan belongs to the next contact: the object may have moved since the last."""
        term, of_scans = self.term, self.number + self.silent
        of_all = of_scans if term is None else np.append(of_scans, term.step)
        steps, which = np.unique(of_all, return_inverse=True)
        known, r = self.terms - len(self), len(steps)
        prior = int(self.prior is not None)
        shares = np.zeros((self.terms, 2 * r))
        shares[:prior, r : r + 1] = 1.0  # the prior counts in the first step
        shares[prior:known, r + which[len(self) :]] = 1.0
        which = which[: len(self)]
        self.of_scans(shares.T).T[np.arange(len(self)), which + r * self.silent] = self.share
        usual = self.anything @ shares[known:]
        touched = np.zeros(r, np.bool_)
        touched[which[self.contact]] = True
        begun = np.array([self.before[step] for step in steps.tolist()])
        usually = float(np.log(HAZARD))
        moves = [self.moves.get(step, usually) for step in steps.tolist()]
        begun += np.array(moves) - begun[:1]
        begun[:1] = 0.0  # evidence is of the remembered scans alone
        opens = touched.copy()
        if term is not None:
            at = int(np.searchsorted(steps, term.step))
            if not touched[at]:  # evidence is in relation to poses that touch, and none did yet
                opens[at] = True
                begun[at] -= (at > 0) * (term.table.log_volume - term.table.log_touched)
        return Runs(shares, usual, touched, begun, opens=opens, is_known=prior > 0)

    def plus(self, observation: Observation, number: int = 0, log_z: float = 0.0) -> "Memory":
        """A memory of one scan more, of contact `number`, or a silent scan after that contact.
        `log_z`: log evidence of all that is remembered so far."""
        told = self.readers[observation.link].read(observation)
        kept, taxels = told.kept, self._kept.shape[2]
        if kept.shape[1] < taxels:  # another link has more: the rest is not live
            kept = np.pad(kept, ((0, 0), (0, taxels - kept.shape[1])))
        made = copy.copy(self)
        made._runs = made._for_c = None
        made._kept = np.concatenate([self._kept, kept[:, None]], axis=1)
        made.link = _and(self.link, observation.link)
        made._sensor = np.concatenate([self._sensor, observation.sensor[None]])
        made._place_m2 = _and(self._place_m2, observation.place_sd_m**2)
        made.number = _and(self.number, number)
        made.newest = max(self.newest, number)
        made.pressed = _and(self.pressed, told.pressed)
        made.anything = _and(self.anything, told.anything)
        made._untouched = _and(self._untouched, told.untouched)
        made.before = {number + (not told.pressed): log_z} | self.before
        return made

    def given(self, term: PriorTerm, log_z: float) -> "Memory":
        """The same with a prior, in place of the one that was given before. `log_z`: as of
        `plus`."""
        made = copy.copy(self)
        made._runs = made._for_c = None
        made.term = term
        made.before = {term.step: log_z} | self.before
        return made

    def scan(self, k: int) -> Observation:
        """The k-th scan as an observation."""
        link = int(self.link[k])
        own = self._kept[:, k, : len(self._links[link].layout)]
        z, level, residue, live = own[[Kept.Z, Kept.LEVEL, Kept.RESIDUE, Kept.LIVE]]
        floor = np.where(z > 0.0, 0.0, level)  # pressed taxels need no floor
        z, sd_m = z.astype(np.float64), float(np.sqrt(self._place_m2[k]))
        return Observation(self._sensor[k], z, live > 0.0, floor, residue, None, link, sd_m)

    def only(self, kept: Bools, *, prior: bool = True) -> "Memory":
        """A memory of the scans in the mask `kept` (K,), with the prior or without."""
        made = copy.copy(self)
        made.prior, made.term = (self.prior, self.term) if prior else (None, None)
        made._runs = made._for_c = None
        made._kept = self._kept.compress(kept, axis=1)  # contiguous, as the C code needs it
        for name in SCANS:
            setattr(made, name, getattr(self, name)[kept])
        steps = {made.term.step} if made.term else set()
        steps.update((made.number + made.silent).tolist())
        made.before = {step: log_z for step, log_z in self.before.items() if step in steps}
        return made

    def anew(self, prior: Prior | None = None) -> "Memory":
        """An empty memory of the same model and slack, with what was known before."""
        made = copy.copy(self)
        made._forget(prior)
        return made

    def adopted(self, other: "Memory") -> "Memory":
        """A memory for this object of the scans that another object's has, and of their slack."""
        made = copy.copy(self)
        made._forget(None)
        for name in (*SCANS, "_kept", "newest", "slack", "moves"):
            setattr(made, name, getattr(other, name))
        first = min(other.before, default=0)
        made.term = self.term
        if made.term is not None:
            made.before = {made.term.step: other.before.get(made.term.step, 0.0)}
        made.before |= {k: z + SWAPPED * (k > first) for k, z in other.before.items()}
        return made

    @property
    def variance(self) -> Floats:
        """(K,) variance of each scan's offset [m²]."""
        return self.slack.variance(self.newest - self.number) + self._place_m2

    def of_scans(self, explained: Floats) -> Floats:
        """Columns of the scans alone: (…, terms) as from `explain` → (…, K)."""
        return explained[..., self.terms - len(self) :]

    def explain(self, poses: Poses) -> Floats:
        """Log-densities of the prior, and of the given one, if there are, and log p(scan | pose)
        over the live taxels of each scan: poses (N, 3) → (N, terms)."""
        scans = self._explain(poses, 0)
        known = [each for each in (self.prior, self.term) if each is not None]
        if not known:
            return scans
        return np.column_stack([*(each.log_density(poses) for each in known), scans])

    def explain_newest(self, poses: Poses) -> Floats:
        """log p(scan | pose) of the newest scan: poses (N, 3) → (N,)."""
        return self._explain(poses, len(self) - 1)[:, 0]

    def foreseen(self, like: Observation, z: Floats, sensor: Poses, poses: Poses) -> Floats:
        """log p(scan | pose) of scans that may come: activations z (S, M) at the sensor's poses (S,
        3), of a skin in the state in which it was at `like`, and poses (N, 3) → (N, S)."""
        floor, residue = (np.broadcast_to(each, len(like.z)) for each in (like.floor, like.residue))
        kept = fields(z, like.live, floor, residue, like.noise or self._noise)
        variance = np.full(len(z), self.slack.variance(np.zeros(1, np.intp))[0])
        silent: Bools = z.max(axis=1) <= 0.0
        code = self._compiled[like.link]
        if code is None:
            met = self._met(self._links[like.link], kept, sensor, variance, silent, poses)
        else:
            met = code.explain(code.scans(kept, sensor, variance, silent), poses)
        return np.asarray(met + kept[Kept.SILENT].sum(axis=1, dtype=np.float64))

    def _explain(self, poses: Poses, since: int) -> Floats:
        """log p(scan | pose) of scans from number `since` on: poses (N, 3) → (N, K − since). Each
        contact has an offset of its own; a silent scan rules out only presses deeper than its
        offset could hide."""
        if len(self._links) == 1:
            met = self._explain_on(0, poses, since, slice(since, None))
        else:
            met = np.empty((len(poses), len(self) - since))
            for link in np.unique(self.link[since:]).tolist():
                at = since + np.flatnonzero(self.link[since:] == link)
                met[:, at - since] = self._explain_on(link, poses, since, at)
        met += self._untouched[since:]
        return met

    def _explain_on(self, link: int, poses: Poses, since: int, at: Index | slice) -> Floats:
        """What pressed taxels of a link add to log p(scan | pose): its scans, which are `at` these
        numbers, of those from `since` on, and poses (N, 3) → (N, scans)."""
        code, of = self._compiled[link], (since, self.newest, self.slack)
        if self._for_c is None or self._for_c[0] != of:
            self._for_c = of, {}
        cached = self._for_c[1]
        if code is not None and link in cached:
            return code.explain(cached[link], poses)
        kept = self._kept[:, at, : len(self._links[link].layout)]
        variance, sensor, silent = self.variance[at], self._sensor[at], self.silent[at]
        if code is None:
            return self._met(self._links[link], kept, sensor, variance, silent, poses)
        cached[link] = code.scans(kept, sensor, variance, silent)
        return code.explain(cached[link], poses)

    def _met(
        self,
        model: ObservationModel,
        kept: Grid,
        sensor: Floats,
        variance: Floats,
        silent: Bools,
        poses: Poses,
    ) -> Floats:
        """`Compiled.explain` in numpy: what pressed taxels add to log p(scan | pose), (N, K)."""
        n, k, taxels = len(poses), len(sensor), len(model.layout)
        order = np.argsort(silent, kind="stable")  # contacts first
        about = k - int(np.count_nonzero(silent))
        near = model.pressed_from(sensor[order], poses, about)
        scan = order.take(near.row // max(n, 1))
        fields = kept.reshape(len(Kept), -1).take(scan * taxels + near.taxel, axis=1)
        z, level, _, untouched, sigma2, gain2, _, _, _, _, _, live = fields
        first, added = slice(0, len(near.gx)), np.zeros(k * n)
        met = self._pressed(near, fields[:, first], np.repeat(variance[order[:about]], n))
        hidden = (HIDDEN / model.depth_max_m) * np.sqrt(variance)
        depth = near.depth - hidden.astype(np.float32).take(scan)
        h = np.minimum(np.maximum(depth, 0.0), 1.0)
        h[first], added[: about * n] = met.h, met.added
        sigma2[first] += met.more * met.more
        spread = sigma2 + gain2 * h * h
        gain = (self._noise.log_of(z, (level - h) / np.sqrt(spread), spread) - untouched) * live
        out = np.empty((n, k))
        out[:, order] = (np.bincount(near.row, gain, k * n) + added).reshape(k, n).T
        return out

    def _pressed(self, near: Nearby, fields: Grid, variance: Floats) -> Pressed:
        """The taxels about presses (P,) with their fields (len(Kept), P), where the offsets of
        their rows, of `variance` (rows,), explain the readings best."""
        _, level, root, _, _, _, sag, most, _, low, high, _ = fields
        rate, farther = (np.maximum(near.along * each, LEAST_RATE) for each in (sag, most))
        row, depth = near.row[: len(rate)], near.depth[: len(rate)]
        readings = Readings(row, level, low, high, depth, near.gx, near.gy, root, rate)
        depth, added, _ = readings.offset(variance)
        h = np.minimum(sagging(depth, rate), 1.0)
        more = np.minimum(sagging(depth, farther), 1.0) - h
        return Pressed(h, more, h * np.maximum(1.0 - depth / rate, 0.0), added)

    def contacts_at(self, poses: Poses, link: int = 0) -> Lesson:
        """The remembered contacts, all of one link, and the depths expected of an object at equally
        likely poses (N, 3)."""
        model = self._links[link]
        scans, n, taxels = np.flatnonzero(self.contact), len(poses), len(model.layout)
        near = model.pressed_from(self._sensor[scans], poses, len(scans))
        at = near.row // n * taxels + near.taxel
        kept = self._kept[:, scans, :taxels]
        fields = kept.reshape(len(Kept), -1).take(at, axis=1)
        met = self._pressed(near, fields, np.repeat(self.variance[scans], n))

        def mean(values: Grid) -> Floats:
            total = np.bincount(at, values, len(scans) * taxels)
            return np.asarray(total.reshape(len(scans), taxels) / n)

        h, square = mean(met.h), mean(met.h * met.h)
        z, live = kept[Kept.Z].astype(np.float64), kept[Kept.LIVE] > 0.0
        floor = np.where(z > 0.0, 0.0, kept[Kept.LEVEL])
        added = square - h * h + kept[Kept.RESIDUE] ** 2
        return Lesson(z, floor, h, mean(met.by_sag), added, live)


def _and(values: NDArray[Number], last: float) -> NDArray[Number]:
    """Values (K,) and one more: like `np.append`, but faster."""
    made = np.empty(len(values) + 1, values.dtype)
    made[:-1] = values
    made[-1] = last
    return made
