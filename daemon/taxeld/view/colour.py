"""The colour of an activation: from dark blue at 0 to yellow at 1, as matplotlib's `plasma`."""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats

_STOPS = np.array(
    [(13, 8, 135), (126, 3, 168), (204, 71, 120), (248, 149, 64), (240, 249, 33)], dtype=float
)
QUIET, DEAD = (120, 120, 120), (200, 30, 30)
LEAST = 0.25  # of the colour scale: darker colours are not seen on the viewer's black


def plasma(z: Floats) -> NDArray[np.uint8]:
    """(n, 3) red, green and blue of activations (n,)."""
    at = np.clip(z, 0.0, 1.0) * (len(_STOPS) - 1)
    rgb = [np.interp(at, np.arange(len(_STOPS)), channel) for channel in _STOPS.T]
    return np.round(np.stack(rgb, axis=-1)).astype(np.uint8)


def of_taxels(z: Floats, live: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(n, 3): from purple to yellow, grey where nothing presses, red where a taxel is dead."""
    colour = plasma(LEAST + (1.0 - LEAST) * z)
    colour[z <= 0.0] = QUIET
    colour[~live] = DEAD
    return colour
