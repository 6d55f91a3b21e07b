"""Whether touches still agree with the skin's calibration: full scale, mount, and module places.

A wrong full scale or mount hardly shows in one touch: the belief takes it for a slightly other
pose. It shows over several touches, as the object does not move with the sensor. So the last
touches are fitted twice: by the object's pose alone, and by that pose together with a factor on all
readings and an offset of the mount. A doubt is raised where the second fit is far likelier and its
factor or offset is large. Two modules that have changed places are found by readings that are
likelier in each other's place.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Self

import numpy as np

from taxeld.arrays import Bools, Floats, Index, Poses, Reals
from taxeld.config.tables import FilterConfig
from taxeld.estimator.rule import noise_of
from taxeld.model import se2
from taxeld.model.observation import Noise, Observation, ObservationModel
from taxeld.model.response import deviation
from taxeld.model.symmetry import Mode

TOUCHES = 16  # touches fitted together, at most; fewer on a large skin
LEAST_TOUCHES = 5
FELT = 0.1  # share of full scale: a touch whose strongest taxel reads less is left out
ROOM = 16 * 80  # touches × taxels: the limit on the work of one step
ITERATIONS = 5  # steps of each fit after a touch, one a scan: a scan has little time
SETTLED_NATS = 0.01  # nats: a step that gains less ends its fit
STEP = np.array([1e-4, 1e-4, 2e-3])  # m, m, rad: steps of the numerical derivatives
PRIOR_SD = np.array([1.0, 0.01, 0.01, 0.15, 0.02, 0.02, 0.2])  # log scale, mount, object
SCALES = np.log([0.4, 1.0, 2.5])  # starting values of the log factor
SHARES = np.array([0.1, 0.3, 1.0])  # shares of a step that are tried; the best is taken
FREEDOM = 4.0  # degrees of freedom of the t distribution that weighs residuals
ONSET_SD = 0.8  # sd of taxels' onsets, in units of `model.response.deviation` (docs/physics.md)
MOVED_M = 0.02  # m between fit and belief: beyond this they are about different places
CANDIDATES = 3  # modes of the belief from which a fit may start
ALONE, TOGETHER = np.arange(4, 7), np.arange(7)  # free parameters: the object's pose, or all seven
SCALE_MOST = np.log(1.6)  # log of the factor: responses of a skin differ in common by up to a third
MOUNT_MOST_M, YAW_MOST = 0.002, np.radians(2.0)
TOUCH_MOST = 30.0  # nats that a touch may cost in full: a touch in the air is no evidence
BEYOND = 0.05  # share of the cost over TOUCH_MOST that still counts, to rank poses that miss
# CERTAIN_NATS: gain of the second fit over the first, without the touch that gains most. A rough
# skin's gains imitate a wrong mount by up to 20 nats, and a mug believed in a wrong place imitates
# a wrong full scale by up to 16.
CERTAIN_NATS = 22.0
SWAPPED_NATS = 30.0  # nats gained when two modules' readings are exchanged
NAMES = 16  # names that a taxel of one module can have


class Suspect(IntEnum):
    """The part of the calibration that a doubt is about."""

    NONE = 0
    SCALE = 1
    MOUNT = 2
    MODULES = 3


@dataclass(slots=True)
class CalibrationDoubt:
    """The doubt that the last touches raise; the figures are offsets from the calibration."""

    suspect: Suspect = Suspect.NONE
    raised: int = 0  # times a doubt began, since start
    nats: float = 0.0  # gain in log-likelihood by the figures, without the touch that gains most
    touches: int = 0  # touches that the figures rest on
    scale: float = 1.0  # factor on all readings
    mount_x_m: float = 0.0
    mount_y_m: float = 0.0
    mount_yaw_rad: float = 0.0


class Read(NamedTuple):
    """Readings of K touches on M taxels."""

    sensor: Poses  # (K, 3)
    z: Floats  # (K, M)
    live: Bools
    floor: Floats
    residue: Floats  # (K, M) activation that may come from other presses

    @classmethod
    def none(cls, taxels: int) -> Self:
        nothing = np.empty((0, taxels))
        return cls(np.empty((0, 3)), nothing, nothing > 0.0, nothing, nothing)

    def at(self, rows: slice) -> Self:
        """The touches in these rows."""
        return self._replace(
            sensor=self.sensor[rows],
            z=self.z[rows],
            live=self.live[rows],
            floor=self.floor[rows],
            residue=self.residue[rows],
        )

    def after(self, touch: Observation) -> Self:
        """The same touches, and another one after them."""
        nothing = np.zeros_like(touch.z)
        return self._replace(
            sensor=np.vstack([self.sensor, touch.sensor]),
            z=np.vstack([self.z, touch.z]),
            live=np.vstack([self.live, touch.live]),
            floor=np.vstack([self.floor, nothing + touch.floor]),
            residue=np.vstack([self.residue, nothing + touch.residue]),
        )

    def is_told(self, expected: Floats) -> Bools:
        """Where the reading tells anything about `expected` (…, K, M) → (…, K, M): the taxel is
        live, and the two are neither both beyond full scale nor both below the floor."""
        saturated = (self.z >= 1.0) & (expected >= 1.0)
        unfelt = (self.z == 0.0) & (expected <= self.floor)
        return np.asarray(self.live & ~saturated & ~unfelt)


class CalibrationCheck:
    """Follows the touches of one belief."""

    def __init__(self, model: ObservationModel, config: FilterConfig) -> None:
        self.doubt = CalibrationDoubt()
        noise = noise_of(config)
        self._model, self._noise = model, noise
        self._moves = config.motion != "none"  # a pushed object has no single place for all touches
        self._most = max(min(TOUCHES, ROOM // len(model.layout)), LEAST_TOUCHES + 1)
        self.reset()

    def reset(self) -> None:
        """Forget every touch; the doubt stands until other touches are judged."""
        self._modules = _Modules(self._model, self._noise)
        self._touches: list[Observation] = []
        self._read = Read.none(len(self._model.layout))
        self._x = np.zeros(7)  # log scale, mount, and the object's pose from `_object`
        self._right = np.zeros(7)  # `_x` under a right calibration: only the pose is free
        self._object: Poses = np.zeros(3)  # where the object was believed to be at the first fit
        self._believed: Poses = np.zeros(3)  # where the object is believed to be now
        self._contact = self._due = 0
        self._strength = 0.0  # sum of the last touch's activations
        self._begun = False

    @property
    def is_due(self) -> bool:
        """Whether `step` has something to do."""
        return self._due > 0

    def on_scan(self, used: Observation | None, modes: Sequence[Mode], contacts: int) -> None:
        """Take the scan that the belief learned from, None where it learned nothing. `modes`: of
        the belief before it, the best first; `contacts`: contacts begun so far."""
        if used is None or self._moves:
            return
        if used.is_contact:
            self._take(used, np.array([mode.pose for mode in modes[:CANDIDATES]]), contacts)
        else:  # silence costs little to learn from
            self.step()

    def step(self) -> None:
        """Take a step of the fits, if one is due: a scan without a touch leaves time for one."""
        if not self._due:
            return
        self._due -= 1
        if self._due >= ITERATIONS:
            self._right, gained = self._better(self._right, ALONE)
        else:
            self._x, gained = self._better(self._x, TOGETHER)
        if gained < SETTLED_NATS:
            self._due = ITERATIONS if self._due >= ITERATIONS else 0
        if not self._due:
            self._judge()

    def _take(self, used: Observation, believed: Poses, contacts: int) -> None:
        strength = float(used.z.sum())
        if used.z.max() < FELT:  # noise and foam's residue touch so lightly
            return
        if contacts == self._contact and self._touches:
            if strength < self._strength:  # only the strongest scan of a contact counts
                return
            self._touches.pop()
            self._read = self._read.at(slice(-1))
        self._strength = strength
        self._contact = contacts
        self._touches = [*self._touches, used][-self._most :]
        self._read = self._read.after(used).at(slice(-self._most, None))
        if len(self._touches) >= LEAST_TOUCHES:
            self._begin(believed)
            self._due = 2 * ITERATIONS

    def _begin(self, believed: Poses) -> None:
        """Start both fits: at the last fits' ends, or at the modes believed now where these are
        better. `believed` is (N, 3)."""
        if not self._begun:
            self._begun, self._object = True, believed[0].copy()
        self._believed = believed[0]
        apart = believed - self._object
        apart[:, 2] = se2.wrap(apart[:, 2])
        tried = np.zeros((len(SCALES), len(apart), 7))
        tried[..., 0] = SCALES[:, None]
        tried[..., 4:7] = apart
        there = np.concatenate([np.zeros(4), self._x[4:7]])
        flat = np.vstack([self._x, self._right, there, tried.reshape(-1, 7)])
        cost = self._cost(flat)
        self._x = flat[cost.argmin()]
        right = np.flatnonzero((flat[:, :4] == 0.0).all(axis=1))
        self._right = flat[right[cost[right].argmin()]]

    def _better(self, x: Floats, free: Index) -> tuple[Floats, float]:
        """One Gauss-Newton step of the parameters `free` on robust residuals, from x (7,); → the
        new x (7,) and the nats gained, or x and 0 where no step is better."""
        residual, jacobian, weight, now = self._linear(x)
        jacobian, prior = jacobian[:, free], PRIOR_SD[free] ** -2.0
        normal = (jacobian.T * weight) @ jacobian + np.diag(prior)
        slope = jacobian.T @ (weight * residual) - x[free] * prior
        tried = np.repeat(x[None], len(SHARES), axis=0)
        tried[:, free] += SHARES[:, None] * np.linalg.solve(normal, slope)
        cost = self._cost(tried)
        gained = now - float(cost.min())
        return (tried[cost.argmin()], gained) if gained > 0.0 else (x, 0.0)

    def _cost(self, x: Floats) -> Floats:
        """Cost [nats] of candidates (N, 7) → (N,)."""
        return np.asarray(self._costs(x).sum(axis=1) + _prior(x))

    def _costs(self, x: Floats) -> Floats:
        """Cost [nats] of candidates (N, 7) touch by touch → (N, K): readings and silent taxels."""
        n, k = len(x), len(self._touches)
        h = self._model.activation(self._seen(x).reshape(-1, 3)).reshape(n, k, -1)
        return self._nats(h, np.exp(x[:, 0])[:, None, None])

    def _nats(self, h: Floats, factor: Floats) -> Floats:
        """Cost [nats] of true activations `h` (…, K, M), all scaled by `factor` → (…, K)."""
        expected, read = factor * h, self._read
        off = np.where(read.is_told(expected), read.z - expected, 0.0)
        at = np.flatnonzero(off)  # few: most taxels are silent, as expected
        of_touch, of_all = at % read.z.size, at // read.z.size
        residue = read.residue.take(of_touch)
        e = off.take(at) / self._sd(expected.take(at), np.ravel(factor).take(of_all), residue)
        nats = np.zeros(off.shape)
        nats.ravel()[at] = np.log1p(e * e / FREEDOM)
        cost = 0.5 * (FREEDOM + 1.0) * nats.sum(axis=-1)
        return np.asarray(
            np.minimum(cost, TOUCH_MOST) + BEYOND * np.maximum(cost - TOUCH_MOST, 0.0)
        )

    def _sd(self, expected: Floats, factor: Floats | float, residue: Floats) -> Floats:
        """Standard deviation of a reading (P,), from noise, the taxel's own response, and what
        other presses may add (`residue`). Residues of saturated readings grow with the factor."""
        within = np.minimum(expected, 1.0)
        own = ONSET_SD * deviation(within)
        other = residue * np.maximum(factor, 1.0)
        return np.sqrt(self._noise.variance(within) + own * own + other * other)

    def _linear(self, x: Floats) -> tuple[Floats, Floats, Floats, float]:
        """Residuals (R,), their slopes (R, 7), their weights (R,), and the cost of x (7,).
        Residuals are in standard deviations."""
        model = self._model
        q = self._seen(x[None])[0]
        factor = np.exp(x[0])
        near = np.concatenate([q, *(q + step for step in np.diag(STEP))])
        h, *ahead = model.activation(near).reshape(4, len(q), -1)
        by_pose = factor * (np.stack(ahead) - h) / STEP[:, None, None]
        expected = factor * h
        cost = float(self._nats(h, factor).sum() + _prior(x[None])[0])
        told = (h > 0.0) & self._read.is_told(expected)
        sd = self._sd(expected, factor, self._read.residue)
        e = ((self._read.z - expected) / sd)[told]
        moves = np.eye(7)[1:] * 1e-6
        gap = self._seen(x + moves) - q
        gap[..., 2] = se2.wrap(gap[..., 2])
        slopes = np.einsum("ckm,nkc->nkm", by_pose, gap / 1e-6)
        jacobian = np.vstack([expected[None], slopes])[:, told].T / sd[told][:, None]
        return e, jacobian, (FREEDOM + 1.0) / (FREEDOM + e * e), cost

    def _seen(self, x: Floats) -> Poses:
        """Poses (N, K, 3) of the object in the sensor's frame, for candidates (N, 7)."""
        mounted = se2.compose(self._read.sensor[None], x[:, None, 1:4])
        return se2.compose(se2.inverse(mounted), (self._object + x[:, 4:7])[:, None])

    def _judge(self) -> None:
        doubt, x = self.doubt, self._x
        self._modules.take(self._touches[-1], self._seen(x[None])[0, -1])
        right, best = self._costs(np.stack([self._right, x]))
        better = right - best
        doubt.touches, doubt.nats = len(better), float(better.sum() - better.max())
        doubt.scale = float(np.exp(x[0]))
        doubt.mount_x_m, doubt.mount_y_m, doubt.mount_yaw_rad = x[1:4].tolist()
        before, doubt.suspect = doubt.suspect, self._suspect()
        doubt.raised += doubt.suspect is not Suspect.NONE and before is Suspect.NONE

    def _suspect(self) -> Suspect:
        """The part of the calibration that is certainly wrong, and by much."""
        if self._modules.most_nats > SWAPPED_NATS:
            return Suspect.MODULES
        x = self._x
        apart = self._believed[:2] - self._object[:2] - x[4:6]
        if self.doubt.nats < CERTAIN_NATS or np.hypot(*apart) > MOVED_M:
            return Suspect.NONE
        if abs(x[0]) > SCALE_MOST:
            return Suspect.SCALE
        off = np.hypot(x[1], x[2]) > MOUNT_MOST_M or abs(x[3]) > YAW_MOST
        return Suspect.MOUNT if off else Suspect.NONE


def _prior(x: Floats) -> Floats:
    """Cost [nats] of the prior at candidates (N, 7) → (N,)."""
    return np.asarray(0.5 * np.square(x / PRIOR_SD).sum(axis=1))


class _Modules:
    """How much likelier each two modules' readings would be in each other's place."""

    def __init__(self, model: ObservationModel, noise: Noise) -> None:
        self._model, self._noise = model, noise
        suis, module = np.unique(model.layout.uid >> 4, return_inverse=True)
        self._place: Index = module * NAMES + (model.layout.uid & (NAMES - 1))
        self._shape = len(suis), NAMES
        self._has = self._spread(np.ones(len(module))) > 0.0
        alike: Bools = (self._has[:, None] == self._has[None, :]).all(axis=2)
        self._alike = alike & ~np.eye(len(suis), dtype=np.bool_)  # with equal taxels
        self._gain = np.zeros(self._alike.shape)

    @property
    def most_nats(self) -> float:
        return float(self._gain.max(initial=0.0))

    def take(self, touch: Observation, seen: Poses) -> None:
        """Take a touch; `seen` (3,): the object's pose in the sensor's frame."""
        m = len(touch.z)
        h = self._spread(self._model.activation(seen[None])[0])
        read = [
            self._spread(np.broadcast_to(each, m))
            for each in (touch.z, touch.live, touch.floor, touch.residue)
        ]
        at = np.flatnonzero((read[0] > 0.0).any(axis=1) | (h > 0.0).any(axis=1))
        told = np.zeros(self._alike.shape)  # log-likelihood of column's readings at row's place
        told[at] = self._likely(h[at, None], *(each[None] for each in read))
        told[:, at] = self._likely(h[:, None], *(each[None, at] for each in read))
        own = np.diag(told)
        gain = told + told.T - own[:, None] - own[None, :]
        self._gain += np.where(self._alike, gain, 0.0)

    def _likely(self, h: Floats, z: Floats, live: Floats, floor: Floats, residue: Floats) -> Floats:
        return np.asarray((self._noise.log_density(z, h, floor, residue) * live).sum(axis=2))

    def _spread(self, values: Reals | Bools) -> Floats:
        """(M,) → (modules, NAMES), 0 where a module has no taxel of that name."""
        spread = np.zeros(self._shape)
        spread.ravel()[self._place] = values
        return spread
