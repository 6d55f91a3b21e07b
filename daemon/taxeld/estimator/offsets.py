"""A robot errs and objects give way: each remembered scan has a small offset of its own.

The sensor's pose at a touch is known only to about a millimetre, and each later touch may have
moved the object as much. So p(z | q) = ∫ p(z | q, e) N(e; 0, s²) de over an offset e of the sensor
in the plane, common to all taxels of the scan. The depth is linear in e, by the gradient of the
distance field; what is read of it sags (`response`). The integral is Laplace's, about the e that
explains the reading best.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Floats, Grid, Index
from taxeld.model.response import LEAST_RATE, sagging

ITERATIONS = 2  # Gauss-Newton steps: taxels come into touch, and leave it, once
HIDDEN = 1.5  # standard deviations of its offset by which a silent scan may be off
LEAST_M2 = 1e-14  # least variance of an offset, for one that has none
ROBUST = 3.0  # standard deviations beyond which a reading pulls no harder (Huber 1964)


@dataclass(frozen=True, slots=True)
class Readings:
    """Pairs (P,) of a taxel's reading and a pose, sorted by row, to find each pose's offset. Single
    precision: there are many pairs, and a thousandth of a nat does not matter."""

    row: Index  # scan and pose of the pair
    level: Grid  # the reading, or its floor where it is 0
    low: Grid  # lower bound on reading − expected [sd]; 0 where a higher expectation fits as well
    high: Grid  # upper bound on reading − expected [sd]; 0 where a lower expectation fits as well
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
        x = y = np.zeros(len(rows))
        depth = self.depth
        for _ in range(ITERATIONS):
            sags = (self.rate > LEAST_RATE) & (depth < self.rate)  # else a straight line
            read = np.where(sags, sagging(depth, self.rate), depth)
            move = np.where(sags, read / self.rate, np.float32(1.0)) * self.root
            ax, ay = self.gx * move, self.gy * move
            off = (self.level - read) * self.root
            off = np.minimum(np.maximum(off, self.low), self.high)
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
