"""Which scans to learn from: a held contact must not sharpen the belief.

- A press is used once, when it stops deepening, because it is strongest then. A shorter tap is used
  by its strongest scan.
- After that, and in free motion, a scan is used whenever the sensor has moved or a taxel is pressed
  much harder. A release tells no more than its press. Silence where the belief expects contact is
  evidence like any other.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from taxeld.arrays import Poses
from taxeld.model.observation import Observation

MOTION_M = 0.005  # a sensor that moved this far is at another place
ACTIVATION = 0.5  # a taxel that rose this much is pressed differently
RISING = 0.02  # growth of the strongest activation that shows a deepening press
RELEASE_S = 0.15  # silence this long ends a contact: a flicker starts no new one


@dataclass(slots=True)
class ContactCount:
    """Contacts begun so far, on all links."""

    contacts: int = 0


@dataclass(slots=True)
class News:
    """Follows the contacts of a skin of radius `radius_m`, and picks the scans to learn from."""

    radius_m: float
    contact: bool = False
    tally: ContactCount = field(default_factory=ContactCount)
    contacts: int = 0  # number of the last contact on this link
    _used: Observation | None = None  # the last scan that was used
    _strongest: float = 0.0  # the strongest activation of the previous scan
    _pending: Observation | None = None  # the strongest scan of a press that is not used yet
    _pressed_s: float = -np.inf  # time of the last scan with a pressed taxel [s]

    def on_scan(self, t: float, observation: Observation) -> Observation | None:
        """The scan to learn from now: this one, or the pending one that it ends; None: nothing
        new."""
        strongest = float(observation.z.max())
        rising = strongest > self._strongest + RISING
        self._strongest = strongest
        if strongest > 0.0:
            used = self._pressed(t, observation, rising=rising)
        else:
            used = self._silent(t, observation)
        self._used = used or self._used
        return used

    def _silent(self, t: float, observation: Observation) -> Observation | None:
        if self._pending is not None:
            return self._ended()
        if t - self._pressed_s <= RELEASE_S:  # just released: neither contact nor free motion
            return None
        self.contact = False
        return observation if self._is_new(observation) else None

    def _pressed(self, t: float, observation: Observation, *, rising: bool) -> Observation | None:
        begun = not self.contact
        self.contact = True
        if begun:
            self.tally.contacts += 1
            self.contacts = self.tally.contacts
        self._pressed_s = t
        if begun or self._pending is not None:
            if self._pending is None or observation.z.max() > self._pending.z.max():
                self._pending = observation
            return None if rising else self._ended(observation)
        return observation if not rising and self._is_new(observation) else None

    def _ended(self, held: Observation | None = None) -> Observation | None:
        """The pending press: the given scan of it, or its strongest where that is placed better."""
        of_press, self._pending = [one for one in (held, self._pending) if one], None
        return min(of_press, key=lambda one: one.place_sd_m, default=None)

    def _is_new(self, observation: Observation) -> bool:
        used = self._used
        if used is None:
            return True
        moved = moved_m(used.sensor, observation.sensor, self.radius_m) / MOTION_M
        risen = float((observation.z - used.z).max()) / ACTIVATION
        return moved + risen >= 1.0


def moved_m(a: Poses, b: Poses, radius_m: float) -> float:
    """Upper bound on how far a point of the skin went between two sensor poses (3,) [m]."""
    (ax, ay, turned_a), (bx, by, turned_b) = a.tolist(), b.tolist()
    turn = (turned_b - turned_a + math.pi) % (2.0 * math.pi) - math.pi
    return float(math.hypot(bx - ax, by - ay) + radius_m * abs(turn))
