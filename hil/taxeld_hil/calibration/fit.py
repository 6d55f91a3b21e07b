"""Fits full scale, gains, responses and mount to presses of a known object.

A taxel that is pressed to the depth h, as a share of full depth, reads F·g·r(h) counts: F is the
full scale, g the taxel's gain and r its response (`taxeld.model.response`). The depth follows from
the robot's pose, the mount and the object's pose. All of these are found together by robust least
squares. Sag of the cover beside a press, and edges, are no part of the model: they make a reading
less certain.
"""

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_array, eye_array, vstack

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.response import response
from taxeld_hil.calibration.presses import Presses

FULL_SCALE_SD = 3.0  # sd of the full scale's logarithm about its value at the start
BEND_MEAN, BEND_SD = 0.05, 0.15  # prior of the common response's bend
MOUNT_SD = np.array([0.02, 0.02, 0.2])  # m, m, rad: sd of the mount about none
GAIN_SD = 0.17  # sd of the logarithm of a taxel's gain
ONSET_MEAN, ONSET_SD = 0.1, 0.8  # prior of a taxel's onset, as in recordings (docs/physics.md)
MODEL_SD = 0.01  # error of a right model, in full scales
SAG_M = 0.004  # beside a press the cover sags by 1/e less at this distance
BESIDE_M = np.array([-0.008, -0.005, -0.0025, 0.0025, 0.005, 0.008])  # distances round the link
SHALLOW, DEEP = 0.04, 0.97  # shares of full depth between which readings are used
FIRM = 0.2  # full scales: a reading so strong is missed where the fit expects no press
MISSED_COST = 4.0  # cost of a missed reading: no fit gains by missing it
SILENT_COST = 1.0  # cost of a firm press that a taxel does not answer
ALIKE = 1.4  # presses by which a taxel's share of answers departs from that of all
LEAST_COSINE = 0.6  # between a taxel's normal and the shortest way out of the object
STEP_M, STEP = 1e-4, 1e-3  # for differences: along x and y, and of all other unknowns
POSE_STEP = np.array([STEP_M, STEP_M, STEP])
FAR = 10.0  # prior sd: unknowns are counted from so far below their means
ROUNDS, STEPS = 8, 25  # most rounds of a fit, and most steps of a round
SETTLED = 0.1  # prior sd: a round that changes no unknown by more is the last
SEARCHED = np.array([0.006, 0.006, np.radians(8.0)])  # largest mounts that are tried: m, m, rad
MOUNTS = 7  # mounts that are tried along each axis
APART = np.array([0.003, 0.003, np.radians(3.0)])  # mounts that differ by less are one start
STARTS = 3  # fits, of which the likeliest is the result
OBJECT_SD = np.array([0.03, 0.03, 0.3])  # m, m, rad: of an object's pose that is not given


class Unknowns(NamedTuple):
    """K presses on M taxels: values, or the standard deviation of each."""

    log_full: Floats  # (1,) logarithm of the full scale in counts
    bend: Floats  # (1,) of the common response
    mount: Poses  # (3,) the sensor's frame in the robot's
    object: Poses  # (3,) in the world
    x: Floats  # (K,) of each press off the place that the robot states [m]
    y: Floats
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
    silent: Bools  # readings of taxels that do not answer a firm press


@dataclass(frozen=True, slots=True)
class FitResult:
    """K presses on M taxels."""

    value: Unknowns
    sd: Unknowns  # `log_gain`: of gain and full scale together
    depth: Floats  # (K, M) shares of full depth
    silent: Bools  # (K, M) taxels that do not answer a firm press
    answers: Floats  # (M,) share of firm presses that each taxel answers, the mean of a beta
    cost: float  # the likeliest of several fits has the least
    left: float  # the cost of a reading, in the mean


class CalibrationFit:
    """The fit of K presses on M taxels."""

    def __init__(
        self, model: ObservationModel, presses: Presses, noise: Floats, start: Start
    ) -> None:
        """`noise` (M,): sd of a reading at rest [counts]."""
        k, m = presses.counts.shape
        self._model, self._presses, self._noise = model, presses, noise
        kinds = [  # number, mean and sd before the presses, step for differences
            (1, np.log(start.full_scale), FULL_SCALE_SD, STEP),
            (1, BEND_MEAN, BEND_SD, STEP),
            (3, 0.0, MOUNT_SD, POSE_STEP),
            (3, start.object, start.object_sd, POSE_STEP),
            (k, 0.0, presses.robot_m, STEP_M),
            (k, 0.0, presses.robot_m, STEP_M),
            (m, 0.0, GAIN_SD, STEP),
            (m, ONSET_MEAN, ONSET_SD, STEP),
        ]
        number = [kind[0] for kind in kinds]
        self._cuts = np.cumsum(number)[:-1]  # between the kinds of unknowns
        self._mean, self._sd, self._step = (
            np.concatenate([np.broadcast_to(one, n) for one, n in zip(each, number, strict=True)])
            for each in [*zip(*kinds, strict=True)][1:]
        )
        # unknowns are sought in prior sd, counted from far below: scipy's steps are shares of them
        self._begin = np.full(len(self._mean), FAR)
        self._begin[2:5] += start.mount / MOUNT_SD
        self._step /= FAR * np.where(self._sd > 0.0, self._sd, 1.0)

    def run(self) -> FitResult:
        """The likeliest values near the start. In each round the conditions are held, so that what
        is minimised has no steps."""
        u = self._begin
        for _ in range(ROUNDS):
            held = self._conditions(u)
            with np.errstate(over="ignore"):  # of a step that goes too far, and is not taken
                found = least_squares(
                    partial(self._terms, held=held),
                    u,
                    jac_sparsity=self._sparsity(held),
                    diff_step=self._step,
                    loss="soft_l1",
                    ftol=1e-4,
                    max_nfev=STEPS,
                )
            moved, u = np.abs(found.x - u).max(), found.x
            if moved < SETTLED:
                break
        # scipy's Jacobian has the loss in it, so this is its Gauss-Newton Hessian
        covariance = np.linalg.inv((found.jac.T @ found.jac).toarray())
        covariance *= np.outer(self._sd, self._sd)
        gains = slice(*self._cuts[5:7])
        variance = np.diag(covariance).copy()
        variance[gains] += variance[0] + 2.0 * covariance[0, gains]
        x, held = self._values(u), self._conditions(u)
        terms, missed = self._terms(u, held), np.count_nonzero(held.missed)
        silent = np.count_nonzero(held.silent)
        cost = (np.hypot(1.0, terms) - 1.0).sum() + MISSED_COST * missed + SILENT_COST * silent
        depth = depths(self._model, self._seen(x))
        firm = (depth > FIRM) & self._presses.live
        answered = firm & ~held.silent
        of_all = answered.sum() / max(firm.sum(), 1)
        return FitResult(
            value=x,
            sd=Unknowns(*np.split(np.sqrt(np.maximum(variance, 0.0)), self._cuts)),
            depth=depth,
            silent=held.silent,
            answers=(answered.sum(axis=0) + ALIKE * of_all) / (firm.sum(axis=0) + ALIKE),
            cost=float(cost),
            left=float(cost / max(len(terms) - len(u) + missed + silent, 1)),
        )

    def _values(self, u: Floats) -> Unknowns:
        return Unknowns(*np.split(self._mean + self._sd * (u - FAR), self._cuts))

    def _seen(self, x: Unknowns) -> Poses:
        """(K, 3) the object in the sensor's frame."""
        sensor = self._presses.sensor.copy()
        sensor[:, :2] += np.stack([x.x, x.y], axis=1)
        return seen(sensor, x.mount, x.object)

    def _conditions(self, u: Floats) -> HeldTerms:
        x = self._values(u)
        q, full, live = self._seen(x), np.exp(x.log_full), self._presses.live
        depth, doubt = depths(self._model, q), _doubt(self._model, q)
        variance = self._noise**2 / 4.0 + (MODEL_SD * full) ** 2 + (doubt * full) ** 2
        silent = (depth > FIRM) & (self._presses.counts < SHALLOW * full) & live
        used = (depth > SHALLOW) & (depth < DEEP) & live & ~silent
        missed = (depth <= SHALLOW) & (self._presses.counts > (FIRM + doubt) * full) & live
        return HeldTerms(_cosine(self._model, q), np.sqrt(variance), used, missed, silent)

    def _terms(self, u: Floats, held: HeldTerms) -> Floats:
        """What is squared and added: residuals of the used readings in sd, in row order, and the
        unknowns themselves."""
        x = self._values(u)
        depth = self._model.activation(self._seen(x)) / held.cosine
        off = (self._presses.counts - _expected(x, depth)) / held.sd
        return np.append(off[held.used], u - FAR)

    def _sparsity(self, held: HeldTerms) -> csr_array:
        """Which terms depend on which unknowns: a reading on one press, one taxel, and all that is
        common."""
        press, taxel = np.nonzero(held.used)
        x, y, gain, onset = self._cuts[3:]
        common = [np.full(len(press), column) for column in range(x)]
        column = np.stack([*common, x + press, y + press, gain + taxel, onset + taxel], axis=1)
        ends = np.arange(0, column.size + 1, column.shape[1])
        ones, shape = np.ones(column.size), (len(press), len(self._mean))
        readings = csr_array((ones, column.ravel(), ends), shape=shape)
        return vstack([readings, eye_array(len(self._mean))])


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


def likeliest(
    model: ObservationModel, presses: Presses, noise: Floats, placed: Poses, *, given: bool
) -> FitResult:
    """The likeliest of several fits, with the object near a pose (3,) in the world, or exactly
    there where that is `given`. They start at the mounts of a grid that leave least of the readings
    unexplained, each with the full scale that suits it best; none near another.

    `noise` (M,): sd of a reading at rest [counts].
    """
    object_sd = np.zeros(3) if given else OBJECT_SD
    y = np.where(presses.live, np.maximum(presses.counts, 0.0), 0.0)
    tried: list[tuple[float, Start]] = []
    for mount in product(*(np.linspace(-most, most, MOUNTS) for most in SEARCHED)):
        h = model.activation(seen(presses.sensor, np.array(mount), placed))
        scale = float((h * y).sum() / max((h * h).sum(), 1e-9))
        start = Start(max(scale, 1.0), np.array(mount), placed, object_sd)
        tried.append((float(np.abs(y - scale * h).sum()), start))
    chosen: list[Start] = []
    for _, start in sorted(tried, key=lambda one: one[0]):
        if all((np.abs(start.mount - other.mount) > APART).any() for other in chosen):
            chosen.append(start)
    fits = [CalibrationFit(model, presses, noise, start).run() for start in chosen[:STARTS]]
    return min(fits, key=lambda fit: fit.cost)


def seen(sensor: Poses, mount: Poses, placed: Poses) -> Poses:
    """(K, 3) the object in the sensor's frame, from robot's poses (K, 3)."""
    return se2.compose(se2.inverse(se2.compose(sensor, mount)), placed)
