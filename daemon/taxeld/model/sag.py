"""The sag of the cover beside a press: the depth that a taxel there reads.

Beside a press of depth d the cover sags by d·exp(−s/λ) at a distance s (a membrane on springs;
docs/physics.md). Where the depth falls by a slope g along the skin, the sag of the points beside
overtakes the depth itself below G = g·λ, and reads G·exp(d/G − 1): the exponential that touches the
line d there. It needs no more than a taxel's own depth and slope, at any pitch.
"""

import numpy as np

from taxeld.arrays import Reals

LENGTH_M = 0.0019  # λ of a taxel and press in the recordings, the median
LENGTH_SD = 0.9  # sd of its logarithm
LEAST = 1e-4  # least G, in shares of full scale: no sag
FARTHEST = 40.0  # G below the line at which nothing is left


def sagging(depth: Reals, rate: Reals) -> Reals:
    """Depths that taxels read at `depth`, below 0 where they are not reached; `rate` is G. All are
    in shares of full scale, of any shapes that broadcast; → their common shape."""
    below = np.minimum(np.maximum(depth / rate - 1.0, -FARTHEST), 0.0)
    return np.asarray(np.where(depth < rate, rate * np.exp(below), depth))
