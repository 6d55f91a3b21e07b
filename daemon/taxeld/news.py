"""What a scan tells that is new: a held touch must sharpen nothing.

- A press is judged once, when it stops deepening, which is when it says most; a tap that ends
  before is judged by its strongest scan.
- After that, and in free motion, a scan counts again whenever the sensor has moved or the touch has
  changed by a unit of news. Silence where the belief expects touch is evidence like any other.
"""

from dataclasses import dataclass

import numpy as np

from taxeld import se2
from taxeld.memory import Felt
from taxeld.se2 import Poses

MOTION_M = 0.005  # a sensor that moved this far feels another place
ACTIVATION = 0.5  # a taxel that changed this much feels another touch
RISING = 0.02  # a strongest activation that grew by more is a press still deepening
RELEASE_S = 0.15  # silence this long ends a contact: a flicker does not start another


@dataclass(slots=True)
class News:
    """Follows the touches of a skin of radius `radius_m`, and picks the scans to learn from."""

    radius_m: float
    contact: bool = False
    contacts: int = 0  # touches begun
    _told: Felt | None = None  # the last scan that was learned from
    _strongest: float = 0.0  # activation of the scan before this one
    _pending: Felt | None = None  # the strongest scan of a press not judged yet
    _felt_s: float = -np.inf  # when anything was felt last

    def on_scan(self, t: float, felt: Felt) -> Felt | None:
        """The scan to learn from now, this one or one that it completes; None: there is no news."""
        strongest = float(felt.z.max())
        rising = strongest > self._strongest + RISING
        self._strongest = strongest
        told = self._pressed(t, felt, rising=rising) if felt.touch else self._silent(t, felt)
        self._told = told or self._told
        return told

    def _silent(self, t: float, felt: Felt) -> Felt | None:
        if self._pending is not None:
            return self._judged()
        if abs(t - self._felt_s) <= RELEASE_S:  # just let go: neither a touch nor free yet
            return None
        self.contact = False
        return felt if self._is_new(felt) else None

    def _pressed(self, t: float, felt: Felt, *, rising: bool) -> Felt | None:
        begun = not self.contact
        self.contact = True
        self.contacts += begun
        self._felt_s = t
        if begun or self._pending is not None:
            if self._pending is None or felt.z.max() > self._pending.z.max():
                self._pending = felt
            return None if rising else self._judged(felt)
        return felt if not rising and self._is_new(felt) else None

    def _judged(self, felt: Felt | None = None) -> Felt | None:
        """The press that has been waited for: as it is held, or its strongest scan."""
        pending, self._pending = self._pending, None
        return felt or pending

    def _is_new(self, felt: Felt) -> bool:
        told = self._told
        if told is None:
            return True
        changed = float(np.abs(felt.z - told.z).max())
        return (
            moved_m(told.sensor, felt.sensor, self.radius_m) / MOTION_M + (changed / ACTIVATION)
            >= 1.0
        )


def moved_m(a: Poses, b: Poses, radius_m: float) -> float:
    """How far a point of the skin went between two sensor poses (3,), at most."""
    gap = se2.compose(se2.inverse(a), b)
    return float(np.hypot(gap[0], gap[1]) + radius_m * abs(gap[2]))
