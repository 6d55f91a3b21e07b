"""Fits full scale, gains, responses and mount to presses of a known object.

A taxel that is pressed to the depth h, as a share of full depth, reads F·g·r(h) counts: F is the
full scale, g the taxel's gain and r its response (`taxeld.model.response`). The depth follows from
the robot's pose, the mount and the object's pose. All of these are found together by robust least
squares. Sag of the cover beside a press, and edges, are no part of the model: they make a reading
less certain.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.sparse import csr_array, eye_array, vstack

from taxeld.arrays import Bools, Floats, Index, Poses
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.response import response
from taxeld_hil.calibration.presses import Presses

FULL_SCALE_SD = 3.0  # sd of the full scale's logarithm about its value at the start
BEND_MEAN, BEND_SD = 0.05, 0.15  # prior of the common response's bend
MOUNT_SD = np.array([0.02, 0.02, 0.2])  # m, m, rad: sd of the mount about none
ROBOT_SD_M = 1e-4  # sd of a press's place along x and y about the robot's pose
GAIN_SD = 0.17  # sd of the logarithm of a taxel's gain
ONSET_MEAN, ONSET_SD = 0.1, 0.8  # prior of a taxel's onset, as in recordings (docs/physics.md)
MODEL_SD = 0.01  # error of a right model, in full scales
SAG_M = 0.004  # beside a press the cover sags by 1/e less at this distance
BESIDE_M = np.array([-0.008, -0.005, -0.0025, 0.0025, 0.005, 0.008])  # distances round the link
SHALLOW, DEEP = 0.04, 0.97  # shares of full depth between which readings are used
FIRM = 0.2  # full scales: a reading so strong is missed where the fit expects no press
MISSED_COST = 4.0  # cost of a missed reading: no fit gains by missing it
LEAST_COSINE = 0.6  # between a taxel's normal and the shortest way out of the object
STEP_M, STEP = 1e-4, 1e-3  # for differences: along x and y, and of all other unknowns
ROUNDS, STEPS = 8, 25  # most rounds of a fit, and most steps of a round
SETTLED = 0.1  # prior sd: a round that changes no unknown by more is the last


class Unknowns(NamedTuple):
    """K presses on M taxels: values, or the standard deviation of each."""

    log_full: Floats  # (1,) logarithm of the full scale in counts
    bend: Floats  # (1,) of the common response
    mount: Poses  # (3,) the sensor's frame in the robot's
    object: Poses  # (3,) in the world
    place: Floats  # (2 K,) x of each press off the place that the robot states, then y [m]
    log_gain: Floats  # (M,)
    onset: Floats  # (M,) of each taxel's response


class Start(NamedTuple):
    """Begin of a fit; poses (3,)."""

    full_scale: float  # counts
    mount: Poses
    object: Poses  # pose in the world
    object_sd: Floats  # (3,) 0: the object is held at that pose


class HeldTerms(NamedTuple):
    """Terms that follow from the unknowns and are held during a round; all (K, M)."""

    cosine: Floats  # between each taxel's normal and the shortest way out of the object
    sd: Floats  # sd of each reading [counts]
    used: Bools  # readings
    missed: Bools  # readings


@dataclass(frozen=True, slots=True)
class FitResult:
    """K presses on M taxels."""

    value: Unknowns
    sd: Unknowns  # `log_gain`: of gain and full scale together
    depth: Floats  # (K, M) shares of full depth
    weight: Floats  # (K, M) of each reading: 0 if it was not used, less than 1 far from the fit
    cost: float  # the likeliest of several fits has the least
    left: float  # the cost of a reading, in the mean

    def expected(self) -> Floats:
        """(K, M) counts."""
        return _expected(self.value, self.depth)


class CalibrationFit:
    """The fit of K presses on M taxels."""

    def __init__(
        self, model: ObservationModel, presses: Presses, noise: Floats, start: Start
    ) -> None:
        """`noise` (M,): sd of a reading at rest [counts]."""
        k, m = presses.counts.shape
        self._model, self._presses, self._noise = model, presses, noise
        self._cuts = np.cumsum([1, 1, 3, 3, 2 * k, m])  # between the kinds of unknowns
        self._mean = np.concatenate(
            [
                [np.log(start.full_scale), BEND_MEAN],
                np.zeros(3),
                start.object,
                np.zeros(2 * k + m),
                np.full(m, ONSET_MEAN),
            ]
        )
        self._sd = np.concatenate(
            [
                [FULL_SCALE_SD, BEND_SD],
                MOUNT_SD,
                start.object_sd,
                np.full(2 * k, ROBOT_SD_M),
                np.full(m, GAIN_SD),
                np.full(m, ONSET_SD),
            ]
        )
        self._begin = np.zeros_like(self._mean)  # unknowns are sought in prior sd about the mean
        self._begin[2:5] = start.mount / MOUNT_SD
        self._gains = slice(8 + 2 * k, 8 + 2 * k + m)
        press, taxel = np.indices((k, m))
        self._columns: list[Index] = [  # for each kind, the unknown that a reading depends on
            *(np.full((k, m), column) for column in range(8)),
            *(8 + press, 8 + k + press, 8 + 2 * k + taxel, 8 + 2 * k + m + taxel),
        ]

    def run(self) -> FitResult:
        """The likeliest values near the start. In each round the conditions are held, so that what
        is minimised has no steps."""
        u = self._begin
        for _ in range(ROUNDS):
            held = self._conditions(u)
            found = self._round(u, held)
            moved, u = np.abs(found.x - u).max(), found.x
            if moved < SETTLED:
                break
        # scipy's Jacobian has the loss in it, so this is its Gauss-Newton Hessian
        return self._fit(u, np.linalg.inv((found.jac.T @ found.jac).toarray()))

    def _values(self, u: Floats) -> Unknowns:
        return self._split(self._mean + self._sd * u)

    def _split(self, x: Floats) -> Unknowns:
        return Unknowns(*np.split(x, self._cuts))

    def _seen(self, x: Unknowns) -> Poses:
        """(K, 3) the object in the sensor's frame."""
        sensor = self._presses.sensor.copy()
        sensor[:, :2] += x.place.reshape(2, -1).T
        return se2.compose(se2.inverse(se2.compose(sensor, x.mount)), x.object)

    def _conditions(self, u: Floats) -> HeldTerms:
        x = self._values(u)
        q, full, live = self._seen(x), np.exp(x.log_full), self._presses.live
        depth, doubt = depths(self._model, q), _doubt(self._model, q)
        variance = self._noise**2 / 4.0 + (MODEL_SD * full) ** 2 + (doubt * full) ** 2
        used = (depth > SHALLOW) & (depth < DEEP) & live
        missed = (depth <= SHALLOW) & (self._presses.counts > (FIRM + doubt) * full) & live
        return HeldTerms(_cosine(self._model, q), np.sqrt(variance), used, missed)

    def _round(self, u: Floats, held: HeldTerms) -> OptimizeResult:
        """The least squares of the readings' residuals and of the unknowns `u` themselves."""
        return least_squares(
            lambda u: np.concatenate([self._residuals(self._values(u), held), u]),
            u,
            lambda u: vstack([self._slopes(u, held), eye_array(len(u))]),
            loss="soft_l1",
            ftol=1e-4,
            max_nfev=STEPS,
        )

    def _residuals(self, x: Unknowns, held: HeldTerms) -> Floats:
        """Residuals of the used readings, in row order and in sd."""
        depth = self._model.activation(self._seen(x)) / held.cosine
        off = (self._presses.counts - _expected(x, depth)) / held.sd
        return np.asarray(off[held.used])

    def _slopes(self, u: Floats, held: HeldTerms) -> csr_array:
        """Derivatives of the residuals by the unknowns `u`. A reading depends on one press and one
        taxel, so the unknowns of all presses, or of all taxels, are varied at once."""
        x = self._mean + self._sd * u
        before = self._residuals(self._split(x), held)
        slopes: list[Floats] = []
        for columns in self._columns:
            kind = columns.flat[0]
            lengths = kind in (2, 3, 5, 6) or 8 <= kind < self._gains.start
            moved = x.copy()
            moved[np.unique(columns)] += (step := STEP_M if lengths else STEP)
            slopes.append((self._residuals(self._split(moved), held) - before) / step)
        column = np.stack([columns[held.used] for columns in self._columns])
        row = np.broadcast_to(np.arange(len(before)), column.shape)
        values = (np.stack(slopes) * self._sd[column]).ravel()
        return csr_array((values, (row.ravel(), column.ravel())), shape=(len(before), len(x)))

    def _fit(self, u: Floats, covariance: Floats) -> FitResult:
        """The result at `u` with this covariance (P, P)."""
        x, held = self._values(u), self._conditions(u)
        residual = self._residuals(x, held)
        weight = np.zeros_like(held.sd)
        weight[held.used] = 1.0 / np.sqrt(1.0 + residual**2)
        missed = np.count_nonzero(held.missed)
        cost = (np.hypot(1.0, np.append(residual, u)) - 1.0).sum() + MISSED_COST * missed
        covariance = covariance * np.outer(self._sd, self._sd)
        variance = np.diag(covariance).copy()
        variance[self._gains] += variance[0] + 2.0 * covariance[0, self._gains]
        return FitResult(
            value=x,
            sd=self._split(np.sqrt(np.maximum(variance, 0.0))),
            depth=depths(self._model, self._seen(x)),
            weight=weight,
            cost=float(cost),
            left=float(cost / max(len(residual) + missed, 1)),
        )


def depths(model: ObservationModel, q: Poses) -> Floats:
    """(K, M) how deep each taxel is pressed along its normal, in shares of full depth, with the
    object at poses (K, 3) in the sensor's frame."""
    return np.asarray(model.activation(q) / _cosine(model, q))


def _cosine(model: ObservationModel, q: Poses) -> Floats:
    """(K, M) between each taxel's normal and the shortest way out of the object."""
    x, y = (
        (model.activation(q + step) - model.activation(q - step)) / (2.0 * STEP_M)
        for step in STEP_M * np.eye(3)[:2]
    )
    along = x * model.layout.normal[:, 0] + y * model.layout.normal[:, 1]
    return np.clip(-along * model.depth_max_m, LEAST_COSINE, 1.0)


def _doubt(model: ObservationModel, q: Poses) -> Floats:
    """(K, M) shares of full depth by which a taxel's depth is uncertain: the cover sags from a
    deeper place beside it, and an edge is not exactly where the model has it."""
    radius = model.layout.radius_m
    turns = np.zeros((len(BESIDE_M), 1, 3))
    turns[:, 0, 2] = -BESIDE_M / radius
    beside = np.array([model.activation(turned) for turned in se2.compose(turns, q)])
    sag = (beside * np.exp(-np.abs(BESIDE_M) / SAG_M)[:, None, None]).max(axis=0)
    rounding = 2.0 * radius * (1.0 - np.cos(BESIDE_M[3] / radius)) / model.depth_max_m
    here = model.activation(q)
    kink = np.abs(beside[2] + beside[3] - 2.0 * here + rounding)
    return np.asarray(np.maximum(sag - here, 0.0) + kink)


def _expected(x: Unknowns, depth: Floats) -> Floats:
    """(K, M) counts at depths (K, M)."""
    return np.asarray(np.exp(x.log_full + x.log_gain) * response(depth, x.bend, x.onset))
