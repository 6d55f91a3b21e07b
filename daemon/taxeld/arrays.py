"""Names for arrays in signatures; shapes stand in docstrings, as (N, 3)."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Reals = NDArray[np.floating]  # single or double precision
Bools = NDArray[np.bool_]
Index = NDArray[np.intp]  # positions in another array
Grid = NDArray[np.float32]  # large tables that need few digits
Poses = NDArray[np.float64]  # (…, 3) x [m], y [m], θ [rad]
