"""Whether touches still agree with the skin's calibration: full scale, mount, and module places.

A wrong full scale or mount hardly shows in one touch: the belief takes it for a slightly other
pose. It shows over several touches, as the object does not move with the sensor. So the last
touches are fitted twice: by the object's pose alone, and by that pose together with a factor on all
readings and an offset of the mount. A doubt is raised where the second fit is far likelier and its
factor or offset is large. Two modules that have changed places are found by readings that are
likelier in each other's place.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from taxeld.arrays import Bools, Floats, Index, Poses, Reals
from taxeld.config.tables import FilterConfig
from taxeld.estimator.rule import noise_of
from taxeld.model import se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
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
FREE = np.arange(7), np.arange(4, 7)  # parameters that each of the two fits changes
SCALE_MOST = np.log(1.6)  # log of the factor: responses of a skin differ in common by up to a third
MOUNT_MOST_M, YAW_MOST = 0.002, np.radians(2.0)
TOUCH_MOST = 30.0  # nats that a touch may cost in full: a touch in the air is no evidence
BEYOND = 0.05  # share of the cost over TOUCH_MOST that still counts, to rank poses that miss
# CERTAIN_NATS: gain of fit 0 over fit 1, without the touch that gains most. A rough skin's gains
# imitate a wrong mount by up to 20 nats, and a mug believed in a wrong place imitates a wrong full
# scale by up to 16.
CERTAIN_NATS = 22.0
SWAPPED_NATS = 30.0  # nats gained when two modules' readings are exchanged
NAMES = 16  # names that a taxel of one module can have


class Suspect(IntEnum):
    """The part of the calibration that a doubt is about."""

    NONE = 0
    SCALE = 1
    MOUNT = 2
    MODULES = 3


@dataclass(frozen=True, slots=True)
class CalibrationDoubt:
    """The doubt that the last touches raise; the figures are offsets from the calibration."""

    suspect: Suspect = Suspect.NONE
    scale: float = 1.0  # factor on all readings
    mount_x_m: float = 0.0
    mount_y_m: float = 0.0
    mount_yaw_rad: float = 0.0


class CalibrationCheck:
    """Follows the touches of one belief.

    Parameters of a fit are (7,): log scale, mount, and the object's pose from `_object`. Fit 0
    changes all of them, fit 1 only the object's pose, as under a right calibration.
    """

    def __init__(self, model: ObservationModel, config: FilterConfig) -> None:
        self.doubt = CalibrationDoubt()
        self._model, self._noise = model, noise_of(config)
        self._moves = config.motion != "none"  # a pushed object has no single place for all touches
        self.reset()

    def reset(self) -> None:
        """Forget every touch; the doubt stands until other touches are judged."""
        most = max(min(TOUCHES, ROOM // len(self._model.layout)), LEAST_TOUCHES + 1)
        self._touches: deque[Observation] = deque(maxlen=most)
        self._contact = 0  # number of the last touch's contact
        self._due = 0  # steps that the fits have left
        self._x = np.zeros((2, 7))  # parameters of both fits
        self._object: Poses = np.empty(0)  # (3,) pose believed at the first fit; empty before
        self._modules = _Modules(self._model, self._noise)

    @property
    def is_due(self) -> bool:
        """Whether `step` has something to do."""
        return self._due > 0

    def on_scan(self, used: Observation | None, modes: Sequence[Mode], contacts: int) -> None:
        """Take the scan that the belief learned from, None where it learned nothing. `modes`: of
        the belief before it, the best first; `contacts`: contacts begun so far."""
        if used is None or self._moves:
            return
        if not used.is_contact:
            self.step()
        elif used.z.max() >= FELT:  # noise and foam's residue touch more lightly
            self._take(used, np.array([mode.pose for mode in modes[:CANDIDATES]]), contacts)

    def step(self) -> None:
        """Take a step of the fits, if one is due: a scan without a touch leaves time for one."""
        if not self._due:
            return
        self._due -= 1
        fit, left = divmod(self._due, ITERATIONS)
        self._x[fit], gained = self._better(self._x[fit], FREE[fit])
        if gained < SETTLED_NATS:
            self._due -= left
        if not self._due:
            self._modules.take(self._touches[-1], self._seen(self._x[:1])[0, -1])
            off = self._x[0, :4].tolist()
            self.doubt = CalibrationDoubt(self._suspect(), float(np.exp(off[0])), *off[1:])

    def _take(self, used: Observation, believed: Poses, contacts: int) -> None:
        """Take a touch, and start both fits: at the last fits' ends, or at the modes `believed` (N,
        3) where these are better."""
        if contacts == self._contact:  # only the strongest scan of a contact counts
            if used.z.sum() < self._touches[-1].z.sum():
                return
            self._touches.pop()
        self._contact = contacts
        self._touches.append(used)
        if len(self._touches) < LEAST_TOUCHES:
            return
        self._due = 2 * ITERATIONS
        self._read, self._believed = _stacked(self._touches), believed[0]
        if not self._object.size:
            self._object = believed[0]
        tried = np.zeros((len(SCALES), len(believed), 7))
        tried[..., 0] = SCALES[:, None]
        tried[..., 4:] = believed - self._object
        tried[..., 6] = se2.wrap(tried[..., 6])
        there = np.where(np.arange(7) < 4, 0.0, self._x[0])
        flat = np.vstack([self._x, there, tried.reshape(-1, 7)])
        cost = self._cost(flat)
        right = (flat[:, :4] == 0.0).all(axis=1)
        self._x = flat[[cost.argmin(), np.where(right, cost, np.inf).argmin()]]

    def _better(self, x: Floats, free: Index) -> tuple[Floats, float]:
        """One Gauss-Newton step of the parameters `free` on robust residuals, from x (7,); → the
        new x (7,) and the nats gained, or x and 0 where no step is better."""
        residual, jacobian, now = self._linear(x)
        jacobian, prior = jacobian[:, free], PRIOR_SD[free] ** -2.0
        weight = (FREEDOM + 1.0) / (FREEDOM + residual * residual)
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
        h = self._model.activation(self._seen(x).reshape(-1, 3))
        return self._nats(h.reshape(len(x), *self._read.z.shape), np.exp(x[:, 0])[:, None, None])

    def _nats(self, h: Floats, factor: Floats) -> Floats:
        """Cost [nats] of true activations `h` (…, K, M), all scaled by `factor` → (…, K)."""
        expected = factor * h
        told = self._is_told(expected)
        e = self._residuals(expected, factor, told)[0]
        nats = np.zeros(h.shape)
        nats[told] = np.log1p(e * e / FREEDOM)
        cost = 0.5 * (FREEDOM + 1.0) * nats.sum(axis=-1)
        return np.asarray(
            np.minimum(cost, TOUCH_MOST) + BEYOND * np.maximum(cost - TOUCH_MOST, 0.0)
        )

    def _is_told(self, expected: Floats) -> Bools:
        """Where a reading tells anything about `expected` (…, K, M) → (…, K, M): the taxel is live,
        and the two are neither both beyond full scale nor both below the floor."""
        read = self._read
        saturated = (read.z >= 1.0) & (expected >= 1.0)
        unfelt = (read.z == 0.0) & (expected <= read.floor)
        return np.asarray(read.live & ~saturated & ~unfelt)

    def _residuals(self, expected: Floats, factor: Floats, told: Bools) -> tuple[Floats, Floats]:
        """Residuals (R,) of the readings `told` (…, K, M), in standard deviations, and these (R,):
        of noise, the taxel's own response, and what other presses may add. Residues of saturated
        readings grow with the factor."""
        z, factor, residue = (
            np.broadcast_to(each, told.shape)[told]
            for each in (self._read.z, factor, self._read.residue)
        )
        within = np.minimum(expected[told], 1.0)
        own = ONSET_SD * deviation(within)
        other = residue * np.maximum(factor, 1.0)
        sd = np.sqrt(self._noise.variance(within) + own * own + other * other)
        return (z - expected[told]) / sd, sd

    def _linear(self, x: Floats) -> tuple[Floats, Floats, float]:
        """Residuals (R,), their slopes (R, 7), both in standard deviations, and the cost of x
        (7,)."""
        q, factor = self._seen(x[None])[0], np.exp(x[0])
        near = np.concatenate([q, *(q + step for step in np.diag(STEP))])
        h, *ahead = self._model.activation(near).reshape(4, len(q), -1)
        by_pose = factor * (np.stack(ahead) - h) / STEP[:, None, None]
        expected = factor * h
        told = (h > 0.0) & self._is_told(expected)
        e, sd = self._residuals(expected, factor, told)
        gap = self._seen(x + np.eye(7)[1:] * 1e-6) - q
        gap[..., 2] = se2.wrap(gap[..., 2])
        slopes = np.einsum("ckm,nkc->nkm", by_pose, gap / 1e-6)
        jacobian = np.vstack([expected[None], slopes])[:, told].T / sd[:, None]
        return e, jacobian, float(self._nats(h, factor).sum() + _prior(x[None])[0])

    def _seen(self, x: Floats) -> Poses:
        """Poses (N, K, 3) of the object in the sensor's frame, for candidates (N, 7)."""
        mounted = se2.compose(self._read.sensor[None], x[:, None, 1:4])
        return se2.compose(se2.inverse(mounted), (self._object + x[:, 4:7])[:, None])

    def _suspect(self) -> Suspect:
        """The part of the calibration that is certainly wrong, and by much."""
        if self._modules.gain.max(initial=0.0) > SWAPPED_NATS:
            return Suspect.MODULES
        x, (free, right) = self._x[0], self._costs(self._x)
        gained = right - free
        apart = self._believed[:2] - self._object[:2] - x[4:6]
        if gained.sum() - gained.max() < CERTAIN_NATS or np.hypot(*apart) > MOVED_M:
            return Suspect.NONE
        if abs(x[0]) > SCALE_MOST:
            return Suspect.SCALE
        off = np.hypot(x[1], x[2]) > MOUNT_MOST_M or abs(x[3]) > YAW_MOST
        return Suspect.MOUNT if off else Suspect.NONE


def _stacked(touches: Iterable[Observation]) -> Observation:
    """K touches as one observation, with a row for each in its arrays: (K, 3) and (K, M)."""
    rows = ((t.sensor, t.z, t.live, t.floor + 0.0 * t.z, t.residue + 0.0 * t.z) for t in touches)
    sensor, z, live, floor, residue = map(np.stack, zip(*rows, strict=True))
    return Observation(sensor, z, live, floor, residue)


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
        has = self._spread(np.ones(len(module))) > 0.0
        alike = (has[:, None] == has[None, :]).all(axis=2)  # with equal taxels
        self._alike: Bools = alike & ~np.eye(len(suis), dtype=np.bool_)
        self.gain = np.zeros(alike.shape)  # nats, of all touches

    def take(self, touch: Observation, seen: Poses) -> None:
        """Take a touch; `seen` (3,): the object's pose in the sensor's frame."""
        h = self._spread(self._model.activation(seen[None])[0])
        read = [self._spread(each) for each in (touch.z, touch.live, touch.floor, touch.residue)]
        at = np.flatnonzero((read[0] > 0.0).any(axis=1) | (h > 0.0).any(axis=1))
        told = np.zeros(self._alike.shape)  # log-likelihood of column's readings at row's place
        told[at] = self._likely(h[at, None], *(each[None] for each in read))
        told[:, at] = self._likely(h[:, None], *(each[None, at] for each in read))
        own = np.diag(told)
        gain = told + told.T - own[:, None] - own[None, :]
        self.gain += np.where(self._alike, gain, 0.0)

    def _likely(self, h: Floats, z: Floats, live: Floats, floor: Floats, residue: Floats) -> Floats:
        return np.asarray((self._noise.log_density(z, h, floor, residue) * live).sum(axis=2))

    def _spread(self, values: Reals | Bools | float) -> Floats:
        """(M,) or one for all → (modules, NAMES), 0 where a module has no taxel of that name."""
        spread = np.zeros(self._shape)
        spread.ravel()[self._place] = values
        return spread
