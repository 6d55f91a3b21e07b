"""Fits what a calibration tells to presses of a known object: Gauss-Newton on robust residuals.

A taxel that the skin's model expects to be pressed to a depth h (share of full depth) reads
F·g·r(h) counts: F the full scale, g its gain, r its response (`model.response`). The depth follows
from where the robot says the sensor is, the mount between the robot's frame and the sensor's, and
where the object stands. All of these are sought together, each with what is known of it before:
gains and onsets spread from taxel to taxel as in recordings, and a robot repeats itself to a tenth
of a millimetre. What the model does not have is uncertainty of a reading: cross-talk of a
module's strongest taxel, sag beside a contact, and edges.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Index, Poses
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.response import bow, deviation, response
from taxeld.skin.presses import Presses

GAIN_SD = 0.17  # of a gain's logarithm, before anything is known of it
ONSET_MEAN, ONSET_SD = 0.1, 0.8  # of an onset, likewise (docs/physics.md)
BEND_MEAN, BEND_SD = 0.05, 0.15
MOUNT_SD = np.array([0.02, 0.02, 0.2])  # m, m, rad
ROBOT_SD_M = 1e-4  # of a press's place, beside what the robot tells of it
MODEL_SD = 0.01  # of full scale: what is left of a right model
SAG_M = 0.004  # the cover sags by 1/e so far beside a press, at most
BESIDE_M = np.array([-0.008, -0.005, -0.0025, 0.0025, 0.005, 0.008])  # round the link, looked at
SHALLOW, DEEP = 0.04, 0.97  # depths of readings that are used, shares of full depth
LEAST_COSINE = 0.6  # between a taxel's normal and the shortest way out of the object
FREEDOM = 4.0  # degrees, of the t distribution that residuals are weighed by
STEP = np.array([1e-4, 1e-4, 2e-3])  # m, m, rad, for derivatives
ITERATIONS = 40
CONVERGED = 1e-6  # relative change of the cost


@dataclass(frozen=True, slots=True)
class Start:
    """What is known before the fit."""

    object: Poses  # (3,) in the world
    object_sd: Floats  # (3,); 0: it is held at that
    mount: Poses  # (3,)


@dataclass(frozen=True, slots=True)
class Fit:
    """M taxels. Each sd is of the normal equations, scaled where the residuals are larger than
    they should be."""

    full_scale: float  # counts
    full_scale_sd: float  # relative
    bend: float
    bend_sd: float
    mount: Poses  # (3,) of the sensor's frame in the robot's
    mount_sd: Floats
    object: Poses  # (3,) in the world
    object_sd: Floats
    gain: Floats  # (M,) of full_scale
    gain_sd: Floats  # (M,) relative, of gain and full scale together
    onset: Floats  # (M,)
    onset_sd: Floats
    touched: NDArray[np.int64]  # (M,) readings that were used of each
    depth: Floats  # (K, M) shares of full depth
    used: Bools  # (K, M) readings
    weight: Floats  # (K, M) of the used: 1 or less where they are off
    cost: float  # of which the least is the best
    chi: float  # root of the mean square of what is left, in its own uncertainty

    def expected(self) -> Floats:
        """(K, M) counts."""
        shape = response(self.depth, self.bend, self.onset)
        return np.asarray(self.full_scale * self.gain * shape)


class _Contacts:
    """Depths of the taxels along their normals, for K poses of the object in the sensor frame."""

    def __init__(self, model: ObservationModel) -> None:
        self._model = model
        self._normal = model.layout.normal[:, :2]

    def depth(self, q: Poses) -> tuple[Floats, Floats]:
        """→ depths (K, M), and their derivatives (3, K, M) by x, y and θ of q."""
        ends = [self._model.activation(q + sign * step)
                for step in np.diag(STEP) for sign in (1.0, -1.0)]  # fmt: skip
        slope = np.stack([(a - b) for a, b in zip(ends[::2], ends[1::2], strict=True)])
        slope /= 2.0 * STEP[:, None, None]
        along = slope[0] * self._normal[:, 0] + slope[1] * self._normal[:, 1]
        cosine = np.clip(-along * self._model.depth_max_m, LEAST_COSINE, 1.0)
        return self._model.activation(q) / cosine, slope / cosine

    def doubtful(self, q: Poses, depth: Floats) -> Floats:
        """(K, M) shares of full depth by which a taxel may read another depth: the cover sags from
        what is deeper beside it, and an edge is not where the model has it."""
        radius = self._model.layout.radius_m
        most = np.zeros_like(depth)
        beside = []
        for arc in BESIDE_M:
            turned = se2.compose(np.array([0.0, 0.0, -arc / radius]), q)
            there = self._model.activation(turned)
            beside.append(there)
            most = np.maximum(most, there * np.exp(-abs(arc) / SAG_M))
        rounding = 2.0 * radius * (1.0 - np.cos(BESIDE_M[3] / radius)) / self._model.depth_max_m
        kink = np.abs(beside[2] + beside[3] - 2.0 * self._model.activation(q) + rounding)
        return np.asarray(np.maximum(most - depth, 0.0) + kink)


def depths(model: ObservationModel, q: Poses) -> Floats:
    """(K, M) how deep each taxel is pressed along its normal, in shares of full depth, the object
    at poses (K, 3) in the sensor frame."""
    return _Contacts(model).depth(q)[0]


class CalibrationFit:
    """K presses on M taxels, as one problem."""

    def __init__(
        self, model: ObservationModel, presses: Presses, noise: Floats, start: Start
    ) -> None:
        """`noise` (M,): counts, of a single reading."""
        self._contacts = _Contacts(model)
        self._model, self._presses, self._start = model, presses, start
        self._noise = noise
        self._k, self._m = presses.counts.shape
        self._module: Index = np.unique(model.layout.uid >> 4, return_inverse=True)[1]
        self._coupled, self._coupled_sd = 0.02, 0.04
        free = start.object_sd > 0.0
        k, m = self._k, self._m
        sd = np.where(free, start.object_sd, 1.0)
        self._free = np.concatenate(
            [np.ones(5, dtype=bool), free, np.ones(2 * (k + m), dtype=bool)]
        )
        self._prior_sd = np.concatenate([
            [3.0, BEND_SD], MOUNT_SD, sd, np.full(2 * k, ROBOT_SD_M), np.full(m, GAIN_SD),
            np.full(m, ONSET_SD),
        ])  # fmt: skip
        self._prior_mean = np.concatenate([
            [0.0, BEND_MEAN], np.zeros(3), start.object, np.zeros(2 * k + m), np.full(m, ONSET_MEAN)
        ])  # fmt: skip

    def run(self) -> Fit:
        x = self._prior_mean.copy()
        x[2:5] = self._start.mount
        x[0] = self._first_scale(x)
        self._prior_mean[0] = x[0]
        cost, normal, slope = self._linear(x)
        damping = 1e-3
        for _ in range(ITERATIONS):
            step = np.zeros_like(x)
            damped = normal + damping * np.diag(np.diag(normal))
            step[self._free] = np.linalg.solve(damped, slope)
            trial = x + step
            found = self._linear(trial)
            if found[0] < cost:
                done = cost - found[0] < CONVERGED * cost
                x, (cost, normal, slope) = trial, found
                damping = max(damping / 5.0, 1e-9)
                if done:
                    break
            else:
                damping *= 8.0
                if damping > 1e6:
                    break
        return self._fit(x, normal, cost)

    def cost_of(self, mounts: Poses) -> Floats:
        """(N,) how badly mounts (N, 3) explain all that was read, each with its own best full
        scale: the share of the readings that is left."""
        q = np.concatenate(
            [self._seen(self._presses.sensor, m, self._start.object) for m in mounts]
        )
        h = self._model.activation(q).reshape(len(mounts), -1)
        y = np.where(self._presses.live, np.maximum(self._presses.counts, 0.0), 0.0).ravel()
        scale = h @ y / np.maximum((h * h).sum(axis=1), 1e-9)
        return np.asarray(np.abs(y - scale[:, None] * h).sum(axis=1) / y.sum())

    def _seen(self, sensor: Poses, mount: Poses, placed: Poses) -> Poses:
        return se2.compose(se2.inverse(se2.compose(sensor, mount)), placed)

    def _poses(self, x: Floats) -> Poses:
        sensor = self._presses.sensor.copy()
        sensor[:, :2] += x[8 : 8 + 2 * self._k].reshape(-1, 2)
        return self._seen(sensor, x[2:5], x[5:8])

    def _pose_slopes(self, x: Floats) -> list[tuple[int, Poses]]:
        """Derivatives of the K poses: columns of x, and (K, 3) each."""
        found = []
        for column in range(2, 10):
            step = np.zeros_like(x)
            at = slice(column, None, 2) if column >= 8 else column
            step[at] = 1e-6
            if column >= 8:
                step[8 + 2 * self._k :] = 0.0
            gap = self._poses(x + step) - self._poses(x - step)
            gap[:, 2] = se2.wrap(gap[:, 2])
            found.append((column, gap / 2e-6))
        return found

    def _first_scale(self, x: Floats) -> float:
        h = self._model.activation(self._poses(x))
        y, live = self._presses.counts, self._presses.live
        for least in (0.3, SHALLOW):
            clear = (h > least) & (h < DEEP) & live
            if clear.any():
                return float(np.log(max(np.median(y[clear] / h[clear]), 1.0)))
        return float(np.log(max(y.max(), 1.0)))  # nothing is met: another start will

    def _linear(self, x: Floats) -> tuple[float, Floats, Floats]:
        """Cost, normal matrix and downhill slope of the free parameters at x."""
        k, m = self._k, self._m
        h, by_pose = self._contacts.depth(self._poses(x))
        r, sd, used, shape, slope = self._residual(x, h)
        row, col = np.nonzero(used)
        n = len(row)
        scale = np.exp(x[0] + x[8 + 2 * k : 8 + 2 * k + m])[col]
        jacobian = np.zeros((n, len(x)))
        jacobian[:, 0] = scale * shape[used]
        jacobian[:, 1] = scale * bow(h[used])
        inner = scale * slope[used]
        at = np.arange(n)
        for column, move in self._pose_slopes(x):
            change = np.einsum("ckm,kc->km", by_pose, move)[used] * inner
            if column < 8:
                jacobian[:, column] = change
            else:
                jacobian[at, column + 2 * row] = change
        jacobian[at, 8 + 2 * k + col] = jacobian[:, 0]
        jacobian[at, 8 + 2 * k + m + col] = scale * deviation(h[used])
        e = r[used] / sd[used]
        weight = (FREEDOM + 1.0) / (FREEDOM + e * e)
        cost = 0.5 * (FREEDOM + 1.0) * np.log1p(e * e / FREEDOM).sum()
        # an unused reading costs as much as one three sd off: nothing is gained by missing it
        pressed = (self._presses.counts > 0.1 * np.exp(x[0])) & self._presses.live
        cost += 4.0 * np.count_nonzero(pressed & (h <= SHALLOW))
        prior = (x - self._prior_mean) / self._prior_sd
        cost += 0.5 * float(prior[self._free] @ prior[self._free])
        whitened = jacobian[:, self._free] / sd[used][:, None]
        normal = (whitened.T * weight) @ whitened + np.diag(self._prior_sd[self._free] ** -2)
        slope_x = whitened.T @ (weight * e) - (prior / self._prior_sd)[self._free]
        return float(cost), normal, slope_x

    def _residual(self, x: Floats, h: Floats) -> tuple[Floats, Floats, Bools, Floats, Floats]:
        """Residuals, their sd, which are used, r(h) and r'(h): all (K, M)."""
        k, m = self._k, self._m
        full, bend = np.exp(x[0]), x[1]
        onset = x[8 + 2 * k + m :]
        scale = full * np.exp(x[8 + 2 * k : 8 + 2 * k + m])
        shape = response(h, bend, onset)
        near = 1e-4
        slope = (response(h + near, bend, onset) - response(h - near, bend, onset)) / (2 * near)
        y = self._presses.counts
        strongest, is_strongest = self._strongest(np.maximum(y, 0.0))
        coupled = np.where(is_strongest, 0.0, strongest)
        doubt = self._contacts.doubtful(self._poses(x), h)
        variance = (
            self._noise**2 / 4.0
            + (MODEL_SD * full) ** 2
            + (self._coupled_sd * coupled) ** 2
            + (doubt * full) ** 2
        )
        used = (h > SHALLOW) & (h < DEEP) & self._presses.live
        r = y - self._coupled * coupled - scale * shape
        return r, np.sqrt(variance), used, shape, slope

    def _strongest(self, y: Floats) -> tuple[Floats, Bools]:
        """(K, M) the strongest reading of each taxel's module, and whether it is its own."""
        modules = int(self._module.max()) + 1
        top = np.zeros((len(y), modules))
        for module in range(modules):
            top[:, module] = y[:, self._module == module].max(axis=1)
        strongest = top[:, self._module]
        return strongest, y >= strongest

    def _fit(self, x: Floats, normal: Floats, cost: float) -> Fit:
        k, m = self._k, self._m
        h, _ = self._contacts.depth(self._poses(x))
        r, sd, used, *_ = self._residual(x, h)
        e = r[used] / sd[used]
        weight = np.zeros_like(r)
        weight[used] = np.minimum((FREEDOM + 1.0) / (FREEDOM + e * e), 1.0)
        chi = float(np.sqrt((weight[used] * e * e).sum() / max(weight[used].sum(), 1.0)))
        covariance = np.zeros((len(x), len(x)))
        covariance[np.ix_(self._free, self._free)] = np.linalg.inv(normal) * max(chi, 1.0) ** 2
        variance = np.diag(covariance)
        gains = slice(8 + 2 * k, 8 + 2 * k + m)
        log_gain = x[gains]
        together = variance[0] + variance[gains] + 2.0 * covariance[0, gains]
        root = np.sqrt(np.maximum(variance, 0.0))
        return Fit(
            full_scale=float(np.exp(x[0])),
            full_scale_sd=float(root[0]),
            bend=float(x[1]),
            bend_sd=float(root[1]),
            mount=np.array([x[2], x[3], se2.wrap(x[4])]),
            mount_sd=root[2:5],
            object=np.array([x[5], x[6], se2.wrap(x[7])]),
            object_sd=root[5:8],
            gain=np.exp(log_gain),
            gain_sd=np.sqrt(np.maximum(together, 0.0)),
            onset=x[gains.stop :],
            onset_sd=root[gains.stop :],
            touched=np.count_nonzero(used & (weight > 0.2), axis=0),
            depth=h,
            used=used,
            weight=weight,
            cost=cost,
            chi=chi,
        )
