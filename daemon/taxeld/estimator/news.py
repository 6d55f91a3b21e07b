"""Which scans to learn from, on one link: the usable ones that tell something new.

A usable scan is finite, in order and in range; stuck taxels and leaked presses are left out. A held
contact must not sharpen the belief:

- A press is used once, when it stops deepening, because it is strongest then. A shorter tap is used
  by its strongest scan.
- After that, and in free motion, a scan is used whenever the sensor has moved or a taxel is pressed
  much harder. A release tells no more than its press. Silence where the belief expects contact is
  evidence like any other.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.observation import Activation, Observation, ObservationModel
from taxeld.model.se2 import JUMP_M

MOTION_M = 0.005  # a sensor that moved this far is at another place
ACTIVATION = 0.5  # a taxel that rose this much is pressed differently
RISING = 0.02  # growth of the strongest activation that shows a deepening press
RELEASE_S = 0.15  # silence this long ends a contact: a flicker starts no new one
SAME = 0.01  # share of full scale: a reading changes only by more than this
WAY_M = 0.1  # m that the skin moves meanwhile: no press lasts unchanged over such a way


@dataclass(slots=True)
class EstimatorCounters:
    """Counters of scans and their use, since start."""

    scans: int = 0
    updates: int = 0  # scans that were learned from
    thoughts: int = 0  # searches, and objects tried again
    jumps: int = 0  # scans whose sensor pose is too far from the last, not used
    stuck: int = 0  # scans in which a taxel read the same as ever, and was left out


class Intake:
    """Makes observations of one link's activations."""

    def __init__(self, model: ObservationModel, counters: EstimatorCounters, link: int = 0) -> None:
        self._link = link
        self.t = -np.inf  # time of the last usable scan [s]
        self._counters = counters
        self._radius_m = model.layout.radius_m
        self._leak = model.leak
        self._sensor: Poses | None = None
        self._stuck = Stuck(len(model.layout))

    def observation(self, activation: Activation, sensor: Poses) -> Observation | None:
        """The observation at the sensor's pose (3,) in the world; None where the scan is of no
        use."""
        a, least, most = activation, float(activation.z.min()), float(activation.z.max())
        is_finite = all(map(math.isfinite, (a.t, least, most, *sensor.tolist())))
        if not is_finite or a.t < self.t:
            return None
        before, self._sensor = self._sensor, sensor
        if before is not None and math.dist(before[:2].tolist(), sensor[:2].tolist()) > JUMP_M:
            self._counters.jumps += 1  # a far pose at which the sensor stays is believed next time
            return None
        self.t = a.t
        z, live, floor, residue = a.z, a.live, a.floor, a.residue
        if least == most == 0.0:  # the usual case: nothing is stuck, and nothing leaks
            self._stuck.released()
        else:
            moved = (
                0.0 if before is None else moved_m(before.tolist(), sensor.tolist(), self._radius_m)
            )
            z = np.clip(z, 0.0, 1.0)
            stuck = self._stuck.on_scan(z, moved) & live
            self._counters.stuck += bool(stuck.any())
            live = live & ~stuck
            z, floor, residue = self._leak.without(np.where(live, z, 0.0), floor, residue)
        return Observation(sensor, z, live, floor, residue, a.noise, self._link, a.place_sd_m)


class Stuck:
    """Stuck taxels read the same wherever the skin goes, so they tell nothing of the world: follows
    how far each taxel was carried while it read the same value above 0."""

    def __init__(self, taxels: int) -> None:
        self._z = np.zeros(taxels)
        self._way_m = np.zeros(taxels)

    def released(self) -> None:
        """Take a scan in which nothing is read."""
        self._z[:] = self._way_m[:] = 0.0

    def on_scan(self, z: Floats, moved_m: float) -> Bools:
        """Take activations z (M,) and the skin's motion since the scan before [m]; → (M,) which
        taxels are stuck. A taxel that reads something else is free at once."""
        same = (z > 0.0) & (np.abs(z - self._z) <= SAME)
        self._way_m = np.where(same, self._way_m + moved_m, 0.0)
        self._z = np.where(same, self._z, z)
        return np.asarray(self._way_m > WAY_M)


class News:
    """Follows the contacts of a skin of radius `radius_m`, and picks the scans to learn from."""

    def __init__(self, radius_m: float) -> None:
        self._radius_m = radius_m
        self.contact = False
        self.contacts = 0  # contacts begun
        self._used: Observation | None = None  # the last scan that was used
        self._strongest = 0.0  # the strongest activation of the previous scan
        self._pending: Observation | None = None  # strongest scan of a press that is not used yet
        self._pressed_s = -np.inf  # time of the last scan with a pressed taxel [s]

    def on_scan(self, t: float, observation: Observation) -> Observation | None:
        """The scan to learn from now: this one, or the pending one that it ends; None: nothing
        new."""
        strongest = float(observation.z.max())
        rising = strongest > self._strongest + RISING
        self._strongest = strongest
        if strongest > 0.0:
            used = self._pressed(t, observation, rising=rising)
        elif self._pending is not None:
            used = self._ended()
        elif t - self._pressed_s <= RELEASE_S:  # just released: neither contact nor free motion
            used = None
        else:
            self.contact = False
            used = observation if self._is_new(observation) else None
        self._used = used or self._used
        return used

    def _pressed(self, t: float, observation: Observation, *, rising: bool) -> Observation | None:
        begun = not self.contact
        self.contact = True
        self.contacts += begun
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
        way = used.sensor.tolist(), observation.sensor.tolist()
        moved = moved_m(*way, self._radius_m) / MOTION_M
        risen = float((observation.z - used.z).max()) / ACTIVATION
        return moved + risen >= 1.0


def moved_m(a: Sequence[float], b: Sequence[float], radius_m: float) -> float:
    """Upper bound on how far a point of the skin went between two sensor poses (3,) [m]."""
    (ax, ay, turned_a), (bx, by, turned_b) = a, b
    turn = (turned_b - turned_a + math.pi) % (2.0 * math.pi) - math.pi
    return float(math.hypot(bx - ax, by - ay) + radius_m * abs(turn))
