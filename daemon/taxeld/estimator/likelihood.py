"""How well poses explain remembered scans, in numpy: the twin of explain.c, and its oracle.

A robot errs and objects give way, so each remembered scan has a small offset of its own: the
sensor's pose at a touch is known only to about a millimetre, and each later touch may have moved
the object as much. So p(z | q) = ∫ p(z | q, e) N(e; 0, s²) de over an offset e of the sensor in the
plane, common to all taxels of the scan. The depth is linear in e, by the gradient of the distance
field; what is read of it sags (`response`). The integral is Laplace's, about the e that explains
the reading best. A silent scan rules out only presses deeper than its offset could hide.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats, Grid, Index, Poses
from taxeld.estimator.scans import Field
from taxeld.model.noise import Noise
from taxeld.model.observation import Nearby, ObservationModel
from taxeld.model.response import LEAST_RATE, sagging

ITERATIONS = 2  # Gauss-Newton steps: taxels come into touch, and leave it, once
HIDDEN = 1.5  # standard deviations of its offset by which a silent scan may be off
LEAST_M2 = 1e-14  # least variance of an offset, for one that has none
ROBUST = 3.0  # standard deviations beyond which a reading pulls no harder (Huber 1964)

Explain = Callable[[Poses], Floats]
"""How well poses (N, 3) explain K scans: log-densities (N, K)."""


@dataclass(frozen=True, slots=True)
class Readings:
    """Pairs (P,) of a taxel's reading and a pose, sorted by row, to find each pose's offset. Single
    precision: there are many pairs, and a thousandth of a nat does not matter."""

    row: Index  # scan and pose of the pair
    z: Grid
    level: Grid  # the reading, or its floor where it is 0
    depth: Grid  # share of full scale, below 0 where the taxel is not reached
    gx: Grid  # slope of the depth over the offset [1/m]
    gy: Grid
    root: Grid  # 1 / standard deviation of the reading; 0 where it cannot be believed
    rate: Grid  # depth below which the cover's sag is read, as of `sagging`

    def offset(self, variance: Floats) -> tuple[Grid, Floats, Floats]:
        """Fit the offsets, of variance (R,) [m²] for each row; → the depths (P,) there, what the
        integral adds to each row's log-likelihood (R,), and the offsets' lengths (R,) [m]."""
        added, size_m = np.zeros((2, len(variance)))
        if not len(self.row):
            return self.depth, added, size_m
        begins = np.flatnonzero(np.diff(self.row, prepend=-1))
        rows = self.row[begins]
        pairs = np.diff(begins, append=len(self.row))
        precision = 1.0 / np.maximum(variance[rows], LEAST_M2)
        low = np.where(self.z < 1.0, -np.float32(np.inf), np.float32(0.0))
        high = np.where(self.z > 0.0, np.float32(np.inf), np.float32(0.0))
        x = y = np.zeros(len(rows))
        depth = self.depth
        for _ in range(ITERATIONS):
            sags = (self.rate > LEAST_RATE) & (depth < self.rate)  # else a straight line
            read = np.where(sags, sagging(depth, self.rate), depth)
            move = np.where(sags, read / self.rate, np.float32(1.0)) * self.root
            ax, ay = self.gx * move, self.gy * move
            off = np.minimum(np.maximum((self.level - read) * self.root, low), high)
            weight = (off != 0.0) * ROBUST / np.maximum(np.abs(off), ROBUST)
            sums = np.array([ax * ax, ax * ay, ay * ay, ax * off, ay * off]) * weight
            xx, xy, yy, bx, by = np.add.reduceat(sums, begins, axis=1).astype(np.float64)
            xx, yy = xx + precision, yy + precision
            bx, by = bx - precision * x, by - precision * y
            det = xx * yy - xy * xy
            x, y = x + (yy * bx - xy * by) / det, y + (xx * by - xy * bx) / det
            along = np.repeat(np.stack([x, y]).astype(np.float32), pairs, axis=1)
            depth = self.depth + self.gx * along[0] + self.gy * along[1]
        added[rows] = -0.5 * ((x * x + y * y) * precision + np.log(det / precision**2))
        size_m[rows] = np.hypot(x, y)
        return depth, added, size_m


class Pressed(NamedTuple):
    """Depths (P,) that taxels about a press read, at the best offset of each row."""

    h: Grid  # share of full scale
    more: Grid  # how much more they read where the cover sags one sd farther
    by_sag: Grid  # slope of h over the logarithm of the sag's length
    added: Floats  # (rows,) what the integral over the offset adds to the log-likelihood


def pressed(near: Nearby, fields: Grid, variance: Floats) -> Pressed:
    """The taxels about presses (P,) with their fields (FIELDS, P), where the offsets of their rows,
    of `variance` (rows,), explain the readings best."""
    z, level, root = fields[[Field.Z, Field.LEVEL, Field.ROOT]]
    rate, farther = (
        np.maximum(near.along * fields[each], LEAST_RATE) for each in (Field.SAG, Field.MOST)
    )
    row, depth = near.row[: len(rate)], near.depth[: len(rate)]
    readings = Readings(row, z, level, depth, near.gx, near.gy, root, rate)
    depth, added, _ = readings.offset(variance)
    h = np.minimum(sagging(depth, rate), 1.0)
    more = np.minimum(sagging(depth, farther), 1.0) - h
    return Pressed(h, more, h * np.maximum(1.0 - depth / rate, 0.0), added)


class NumpyExplainer:
    """Explains scans of one skin by poses of one object, where no C code is."""

    def __init__(self, model: ObservationModel, noise: Noise) -> None:
        self._model, self._noise = model, noise

    def of(self, fields: Grid, sensor: Floats, variance: Floats, silent: Bools) -> Explain:
        """What pressed taxels add to log p(scan | pose) of K scans: `fields` (FIELDS, K, M) at the
        sensor's poses (K, 3). `variance` (K,) of the offsets is in m²; `silent` (K,)."""
        return partial(self._explain, fields, sensor, variance, silent)

    def _explain(
        self, fields: Grid, sensor: Floats, variance: Floats, silent: Bools, poses: Poses
    ) -> Floats:
        model, n, k = self._model, len(poses), len(sensor)
        order = np.argsort(silent, kind="stable")  # contacts first
        about = k - int(np.count_nonzero(silent))
        near = model.pressed_from(sensor[order], poses, about)
        scan = order.take(near.row // max(n, 1))
        at = scan * len(model.layout) + near.taxel
        told = fields.reshape(len(Field), -1).take(at, axis=1)
        first, added = slice(0, len(near.gx)), np.zeros(k * n)
        met = pressed(near, told[:, first], np.repeat(variance[order[:about]], n))
        hidden = (HIDDEN / model.depth_max_m) * np.sqrt(variance)
        depth = near.depth - hidden.astype(np.float32).take(scan)
        h = np.minimum(np.maximum(depth, 0.0), 1.0)
        h[first], added[: about * n] = met.h, met.added
        told[Field.SIGMA2, first] += met.more * met.more
        spread = told[Field.SIGMA2] + told[Field.GAIN2] * h * h
        off = (told[Field.LEVEL] - h) / np.sqrt(spread)
        gain = self._noise.log_of(told[Field.Z], off, spread) - told[Field.SILENT]
        gain *= told[Field.ROOT] > 0.0
        out = np.empty((n, k))
        out[:, order] = (np.bincount(near.row, gain, k * n) + added).reshape(k, n).T
        return out
