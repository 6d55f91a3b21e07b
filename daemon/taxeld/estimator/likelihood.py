"""How well poses explain remembered scans, in numpy: the twin of explain.c, and its oracle.

A robot errs and objects give way, so each remembered scan has an offset e of its own of the sensor
in the plane: p(z | q) = ∫ p(z | q, e) N(e; 0, s²) de. A press tells e to a tenth of a millimetre
across the surface and hardly along it, so that the integrand is a ridge, often a bent one. It is
climbed by Gauss-Newton steps. Three nodes along it are summed, with Laplace's integral across it at
each. A silent scan rules out only presses deeper than its offset could hide.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats, Grid, Index, Poses
from taxeld.estimator.scans import Field
from taxeld.model import se2
from taxeld.model.noise import Noise
from taxeld.model.observation import BAND_M, Nearby, ObservationModel
from taxeld.model.response import LEAST_RATE, sagging

STEPS = 5  # of Gauss-Newton, at most
ENOUGH = 0.1  # nats: a step that promises less is not taken
MOST = 1.0  # nats that a step promises, at most, which is not taken
CLEAR = 3.0  # standard deviations at rest beyond which a reading is a press, not the cover's sag
FAR = 2.5  # standard deviations of its offset: taxels so far beside a press are looked up
HIDDEN = 1.5  # standard deviations of its offset by which a silent scan may be off
LEAST_M2 = 1e-10  # variance up to which there is no offset
ROBUST = 3.0  # standard deviations beyond which a reading pulls no harder (Huber 1964)
NODE = 2.0**0.5  # standard deviations along the ridge between its top and the nodes beside
WEIGHTS = 0.5, 0.25 * np.e, 0.25 * np.e  # of the top and of these, as a Gaussian has them

Explain = Callable[[Poses], Floats]
"""How well poses (N, 3) explain K scans: log-densities (N, K)."""


class Fit(NamedTuple):
    """p(z | q, e) N(e; 0, s²) beside that of a skin not pressed, of n rows at an offset each."""

    offset: Floats  # (n, 2) [m]
    log_p: Floats  # (n,)
    slope: Floats  # (n, 2)
    curve: Floats  # (n, 2, 2) less the second derivatives


@dataclass(frozen=True, slots=True)
class Touches:
    """R rows, a scan and a pose each, whose offsets are not known."""

    model: ObservationModel
    noise: Noise
    fields: Grid  # (FIELDS, K, M) of K scans
    seen: Poses  # (R, 3) sensors in the object's frame, scan by scan
    variance: Floats  # (R,) of the offset [m²]
    silent: Bools  # (R,)

    @property
    def far_m(self) -> Floats:
        """(R,) how far off a touch may be; 0 without an offset to be found."""
        return FAR * np.sqrt(self.variance * ((self.variance > LEAST_M2) & ~self.silent))

    def near(self, rows: Index, offset: Floats, *, first: bool = False) -> tuple[Nearby, Grid]:
        """The taxels about a press at offsets (n, 2), and their fields; `first`: of all offsets."""
        seen = self.seen[rows]
        seen[:, :2] += offset
        near = self.model.near(seen, np.maximum(first * self.far_m[rows], BAND_M))
        row = rows.take(near.row)
        told = self.fields[:, row // max(len(self.seen) // self.fields.shape[1], 1), near.taxel]
        told[[Field.SAG, Field.MOST]] *= ~self.silent[row]
        hidden = HIDDEN / self.model.depth_max_m * np.sqrt(self.variance * self.silent)
        return near._replace(depth=near.depth - hidden.astype(np.float32).take(row)), told

    def fit(self, rows: Index, offset: Floats, *, first: bool = False) -> Fit:
        """Rows (n,) at offsets (n, 2). No sag pulls where nothing is touched, so at the `first`
        offset clear presses pull as if the cover did not sag."""
        near, told = self.near(rows, offset, first=first)
        z, level, live, silent, sigma2, gain2, sag, most, quiet = told[: Field.RESIDUE]
        rate, farther = (np.maximum(near.along * each, LEAST_RATE) for each in (sag, most))
        low, high = sagging(near.depth, rate), sagging(near.depth, farther)
        h = np.minimum(low, 1.0)
        spread = sigma2 + gain2 * h * h + (np.minimum(high, 1.0) - h) ** 2
        root = 1.0 / np.sqrt(spread)
        log_p = self.noise.log_of(z, (level - h) * root, spread, quiet)
        gain = log_p - silent
        may_answer = np.maximum(1.0 - quiet * np.exp(-log_p), 0.0)
        root *= np.sqrt(may_answer)  # a taxel that may be silent pulls less
        slow, read = (farther, high) if first else (rate, low)
        straight = (slow <= LEAST_RATE) | (near.depth >= slow)
        straight |= first & (z * z > CLEAR**2 * sigma2)
        off = (level - np.where(straight, near.depth, read)) * root
        off *= ((z < 1.0) | (off > 0.0)) & ((z > 0.0) | (off < 0.0))
        weight = (off != 0.0) * ROBUST / np.maximum(np.abs(off), ROBUST)
        move = np.where(straight, 1.0, read / slow) * root
        x, y = near.gx * move, near.gy * move
        parts = [gain, *(weight * np.array([x * off, y * off, x * x, x * y, x * y, y * y]))]
        n, precision = len(rows), 1.0 / np.maximum(self.variance[rows, None], LEAST_M2)
        total, *sums = (np.bincount(near.row, each * (live > 0.0), n) for each in parts)
        total = total - 0.5 * (precision * offset * offset).sum(axis=1)
        slope = np.transpose(sums[:2]) - precision * offset
        curve = np.transpose(sums[2:]).reshape(n, 2, 2) + precision[:, :, None] * np.eye(2)
        return Fit(offset, total, slope, curve)

    def top(self) -> Fit:
        """The best on the way up (R,)."""
        rows = np.arange(len(self.seen))
        fit = self.fit(rows, np.zeros((len(rows), 2)), first=True)
        top = Fit(*(each.copy() for each in fit))
        for _ in range(STEPS):
            step = np.linalg.solve(fit.curve, fit.slope[:, :, None])[:, :, 0]
            goes = (0.5 * (step * fit.slope).sum(axis=1) >= ENOUGH) & (self.far_m[rows] > 0.0)
            rows = rows[goes]
            fit = self.fit(rows, (fit.offset + step)[goes])
            better = fit.log_p > top.log_p[rows]
            for kept, new in zip(top, fit, strict=True):
                kept[rows[better]] = new[better]
        return top

    def log_p(self) -> Floats:
        """(R,) log-densities, over all offsets."""
        top = self.top()
        total, reaches = top.log_p.copy(), self.model.reaches(self.seen, self.far_m)
        rows = np.flatnonzero(reaches & (self.far_m > 0.0))
        fit = Fit(*(each[rows] for each in top))
        (xx, xy), (_, yy) = fit.curve.T
        turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        across, along = (np.column_stack([np.cos(a), np.sin(a)]) for a in (turn, turn + np.pi / 2))
        width = 1.0 / np.sqrt(np.einsum("ni,nij,nj->n", along, fit.curve, along))
        nodes = [_laplace(fit, across)[0]]
        for side in (NODE, -NODE):
            at = fit.offset + side * width[:, None] * along
            node, step = _laplace(self.fit(rows, at), across)
            on = np.flatnonzero(step.any(axis=1))
            again = _laplace(self.fit(rows[on], (at + step)[on]), across[on])[0]
            node[on] = np.maximum(node[on], again)
            nodes.append(node)
        most = np.max(nodes, axis=0)
        summed = np.dot(WEIGHTS, np.exp(nodes - most)) * width / self.variance[rows]
        total[rows] = most + np.log(summed)
        return total


def _laplace(fit: Fit, across: Floats) -> tuple[Floats, Floats]:
    """Laplace's integral (n,) over a line `across` (n, 2) the ridge, and the step (n, 2) to its
    top, 0 where it promises too little."""
    curve = np.einsum("ni,nij,nj->n", across, fit.curve, across)
    step = (fit.slope * across).sum(axis=1) / curve
    promise = 0.5 * step * step * curve
    value = fit.log_p + np.minimum(promise, MOST) - 0.5 * np.log(curve)
    return value, across * (step * (promise >= ENOUGH))[:, None]


class NumpyExplainer:
    """Explains scans of one skin by poses of one object, where no C code is."""

    def __init__(self, model: ObservationModel, noise: Noise) -> None:
        self._model, self._noise = model, noise

    def column(self, fields: Grid) -> Grid:
        """A scan's fields (FIELDS, M) as `of` takes them."""
        return fields

    def of(
        self, columns: Sequence[Grid], sensor: Poses, variance: Floats, silent: Bools
    ) -> Explain:
        """What pressed taxels add to log p(scan | pose) of K scans at the sensor's poses (K, 3).
        `variance` (K,) of the offsets is in m²; `silent` (K,)."""
        fields = np.stack(columns, axis=1)

        def explained(poses: Poses) -> Floats:
            touches = self.touches(fields, sensor, variance, silent, poses)
            return touches.log_p().reshape(len(sensor), len(poses)).T

        return explained

    def touches(
        self, fields: Grid, sensor: Poses, variance: Floats, silent: Bools, poses: Poses
    ) -> Touches:
        """Scans as of `of`, their fields (FIELDS, K, M), each with each of the poses (N, 3)."""
        seen, n = se2.compose(se2.inverse(poses), sensor[:, None]).reshape(-1, 3), len(poses)
        loose, quiet = np.repeat(variance, n), np.repeat(silent, n)
        return Touches(self._model, self._noise, fields, seen, loose, quiet)
