"""What a taxel reads at a depth, in shares of its own full scale, and the depth of a reading.

A taxel's curve is r(h) = h + bend·h(1 − h) + onset·d(h): the bend is common, the onset its own. The
deviation d rises at once and falls slowly: taxels of a recorded insole differ mostly by it
(docs/physics.md). Beyond full depth the curve is the line r = h.

Beside a press of depth d the cover sags by d·exp(−s/λ) at a distance s (a membrane on springs).
Where the depth falls by a slope g along the skin, the sag of the points beside overtakes the depth
itself below G = g·λ, and reads G·exp(d/G − 1): the exponential that touches the line d there. It
needs no more than a taxel's own depth and slope, at any pitch.
"""

import numpy as np

from taxeld.arrays import Floats, Index, Reals

ONSET = 0.15  # share of full depth within which a taxel's own deviation has risen
GRID = np.linspace(0.0, 1.0, 257)  # depths at which a curve is inverted
STEPS = 128  # steps of reading between which the depth is interpolated
SAG_M = 0.0019  # λ of a taxel and press in the recordings, the median
SAG_SD = 0.9  # sd of its logarithm
LEAST_RATE = 1e-4  # least G, in shares of full scale: no sag
FARTHEST_RATES = 40.0  # G below the line at which nothing is left
_END = -np.expm1(-1.0 / ONSET)
_SLOPE = 1.0 / (ONSET * _END) - 1.0  # slope at 0: d begins with a slope of 1


def deviation(h: Floats) -> Floats:
    """d at depths h (any shape), → the same shape: 0 at 0 and from 1 on, with a slope of 1 at 0."""
    h = np.clip(h, 0.0, 1.0)
    return np.asarray((-np.expm1(-h / ONSET) / _END - h) / _SLOPE)


def response(h: Floats, bend: float | Floats, onset: Floats) -> Floats:
    """Readings at depths h, both in shares of full scale. All of h, bend and onset have shapes that
    broadcast, such as (N, M) and (M,)."""
    within = np.clip(h, 0.0, 1.0)
    return np.asarray(h + bend * (within * (1.0 - within)) + onset * deviation(h))


def sagging(depth: Reals, rate: Reals) -> Reals:
    """Depths that taxels read at `depth`, below 0 where they are not reached; `rate` is G. All are
    in shares of full scale, of any shapes that broadcast; → their common shape."""
    below = np.minimum(np.maximum(depth / rate - 1.0, -FARTHEST_RATES), 0.0)
    return np.asarray(np.where(depth < rate, rate * np.exp(below), depth))


class Inverse:
    """Depths of M taxels from their readings, both in shares of full scale, by a table: a scan has
    little time."""

    def __init__(self, bend: float, onset: Floats) -> None:
        """`onset` (M,). A curve that falls somewhere is read at its running maximum."""
        rising = np.maximum.accumulate(response(GRID, bend, onset[:, None]), axis=1)
        at = np.linspace(0.0, 1.0, STEPS + 1)
        # A tiny slope makes a level stretch invertible.
        rows = [np.interp(at, row / row[-1] + 1e-9 * (GRID - 1.0), GRID) for row in rising]
        self._table = np.stack(rows).ravel()
        self._first: Index = np.arange(len(onset)) * (STEPS + 1)

    def __call__(self, reading: Floats) -> Floats:
        """Depths (M,) in 0..1 for readings (M,), which are clipped to 0..1. A reading of full scale
        gives exactly 1: saturated."""
        place = np.clip(reading, 0.0, 1.0) * STEPS
        step = np.minimum(place.astype(np.intp), STEPS - 1)
        at = self._first + step
        share = place - step
        return np.asarray((1.0 - share) * self._table.take(at) + share * self._table.take(at + 1))
