"""A robot errs and an object gives way: each remembered scan has a small offset of its own.

The sensor's pose at a touch is known to about a millimetre only, and since then the object may have
moved by as much at each touch. So p(z | q) = ∫ p(z | q, e) N(e; 0, s²) de over an offset e of the
sensor in the plane, that all taxels of the scan share. The depth is linear in e, by the gradient of
the distance field; the integral is Laplace's, about the e that explains the reading best.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats

ITERATIONS = 2  # of Gauss and Newton: taxels come into touch, and leave it, once
ROBUST = 3.0  # standard deviations from which a reading pulls no harder (Huber 1964)


@dataclass(frozen=True, slots=True)
class Readings:
    """Pairs (P,) of a taxel's reading and a pose: what is needed to find the pose's offset."""

    row: NDArray[np.intp]  # scan and pose that the pair is of
    z: Floats
    floor: Floats
    depth: Floats  # share of full scale, below 0 where the taxel is not reached
    gx: Floats  # by which it grows with the offset [1/m]
    gy: Floats
    weight: Floats  # 1 / variance of the reading; 0: it is not to be believed

    def offset(self, variance: Floats) -> tuple[Floats, Floats]:
        """Of rows (R,) whose offsets have these variances [m²] → the depth (P,) there, and log of
        what the integral adds to the likelihood there (R,)."""
        rows, row = len(variance), self.row
        depth = self.depth
        x = y = np.zeros(rows)
        root = np.sqrt(self.weight)
        for _ in range(ITERATIONS):
            off = self._off(depth)
            weight = np.where(off == 0.0, 0.0, self.weight)
            weight = weight / np.maximum(np.abs(off) * root / ROBUST, 1.0)
            off = off + (depth - self.depth)  # as seen from no offset
            wx, wy = weight * self.gx, weight * self.gy
            xx = np.bincount(row, wx * self.gx, rows) + 1.0 / variance
            xy = np.bincount(row, wx * self.gy, rows)
            yy = np.bincount(row, wy * self.gy, rows) + 1.0 / variance
            bx, by = np.bincount(row, wx * off, rows), np.bincount(row, wy * off, rows)
            det = xx * yy - xy * xy
            x, y = (yy * bx - xy * by) / det, (xx * by - xy * bx) / det
            depth = self.depth + self.gx * x.take(row) + self.gy * y.take(row)
        added = -0.5 * ((x * x + y * y) / variance + np.log(det * variance * variance))
        return depth, added

    def _off(self, depth: Floats) -> Floats:
        """By how much readings are more than is expected; 0 where they tell nothing more."""
        z = self.z
        off = np.where(z > 0.0, z, self.floor) - depth
        tells = np.where(z > 0.0, (z < 1.0) | (off > 0.0), off < 0.0)
        return np.where(tells, off, 0.0)
