"""A robot errs and an object gives way: each remembered scan has a small offset of its own.

The sensor's pose at a touch is known to about a millimetre only, and since then the object may have
moved by as much at each touch. So p(z | q) = ∫ p(z | q, e) N(e; 0, s²) de over an offset e of the
sensor in the plane, that all taxels of the scan share. The depth is linear in e, by the gradient of
the distance field; the integral is Laplace's, about the e that explains the reading best.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Floats, Grid, Index

ITERATIONS = 2  # of Gauss and Newton: taxels come into touch, and leave it, once
HIDDEN = 1.5  # standard deviations of its offset that a silent scan may be off
LEAST_M2 = 1e-12  # variance of an offset: none at all
ROBUST = 3.0  # standard deviations from which a reading pulls no harder (Huber 1964)


@dataclass(frozen=True, slots=True)
class Readings:
    """Pairs (P,) of a taxel's reading and a pose, in order of their rows: what is needed to find
    the pose's offset. Single precision: they are many, and a thousandth of a nat is nothing."""

    row: Index  # scan and pose that the pair is of
    level: Grid  # the reading, or its floor where it is 0
    low: Grid  # the least and the most that it may be said to be above what is expected: 0 where
    high: Grid  # the other side tells nothing, beyond full scale or under the floor
    depth: Grid  # share of full scale, below 0 where the taxel is not reached
    gx: Grid  # by which it grows with the offset [1/m]
    gy: Grid
    root: Grid  # 1 / standard deviation of the reading; 0: it is not to be believed

    def offset(self, variance: Floats) -> tuple[Grid, Floats, Floats]:
        """Of rows (R,) whose offsets have these variances [m²] → the depth (P,) there, log of what
        the integral adds to the likelihood there (R,), and the length of the offset (R,) [m]."""
        added, size_m = np.zeros((2, len(variance)))
        if not len(self.row):
            return self.depth, added, size_m
        begins = np.flatnonzero(np.diff(self.row, prepend=-1))
        rows = self.row[begins]
        pairs = np.diff(begins, append=len(self.row))
        precision = 1.0 / np.maximum(variance[rows], LEAST_M2)
        away = (self.level - self.depth) * self.root  # in standard deviations, at no offset
        slope = np.array([self.gx, self.gy])
        slope *= self.root
        ax, ay = slope
        squares = np.array([ax * ax, ax * ay, ay * ay])
        sums = np.empty((5, len(away)), np.float32)
        x = y = np.zeros(len(rows))
        off = away
        for _ in range(ITERATIONS):
            off = np.minimum(np.maximum(off, self.low), self.high)
            size = np.maximum(np.abs(off), ROBUST)
            weight = (off != 0.0) * ROBUST / size
            np.multiply(squares, weight, out=sums[:3])
            np.multiply(slope, off * weight, out=sums[3:])
            xx, xy, yy, bx, by = np.add.reduceat(sums, begins, axis=1).astype(np.float64)
            xx, yy = xx + precision, yy + precision
            bx, by = bx - precision * x, by - precision * y
            det = xx * yy - xy * xy
            x, y = x + (yy * bx - xy * by) / det, y + (xx * by - xy * bx) / det
            along = np.repeat(np.stack([x, y]).astype(np.float32), pairs, axis=1)
            off = away - ax * along[0] - ay * along[1]
        added[rows] = -0.5 * ((x * x + y * y) * precision + np.log(det / precision**2))
        size_m[rows] = np.hypot(x, y)
        return self.depth + self.gx * along[0] + self.gy * along[1], added, size_m
