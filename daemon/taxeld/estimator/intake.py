"""The usable part of a scan: finite, in order, in range, without stuck taxels or leaked presses."""

import math

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.estimator.news import moved_m
from taxeld.estimator.rule import EstimatorCounters
from taxeld.model.observation import Activation, Observation, ObservationModel
from taxeld.model.se2 import JUMP_M

SAME = 0.01  # share of full scale: a reading changes only by more than this
WAY_M = 0.1  # m that the skin moves meanwhile: no press lasts unchanged over such a way


class Intake:
    """Makes observations of one skin's activations."""

    def __init__(self, model: ObservationModel, counters: EstimatorCounters, link: int = 0) -> None:
        self._link = link
        self.t = -np.inf  # time of the last used scan [s]
        self._counters = counters
        self._radius_m = model.layout.radius_m
        self._leak = model.leak
        self._sensor: Poses | None = None
        self._stuck = Stuck(len(model.layout))

    def observation(self, activation: Activation, sensor: Poses) -> Observation | None:
        """The observation at the sensor's pose (3,) in the world; None where the scan is of no
        use."""
        a, least, most = activation, float(activation.z.min()), float(activation.z.max())
        if not self._is_usable(a.t, sensor, least, most):
            return None
        before, self._sensor, self.t = self._sensor, sensor, a.t
        if least == most == 0.0:  # the usual case: nothing is stuck, and nothing leaks
            self._stuck.released()
            z, live, floor, residue = a.z, a.live, a.floor, a.residue
            return Observation(sensor, z, live, floor, residue, a.noise, self._link, a.place_sd_m)
        moved = 0.0 if before is None else moved_m(before, sensor, self._radius_m)
        z = np.clip(activation.z, 0.0, 1.0)
        stuck = self._stuck.on_scan(z, moved) & activation.live
        self._counters.stuck += bool(stuck.any())
        live = activation.live & ~stuck
        z, floor, residue = self._leak.without(
            np.where(live, z, 0.0), activation.floor, activation.residue
        )
        return Observation(sensor, z, live, floor, residue, a.noise, self._link, a.place_sd_m)

    def _is_usable(self, t: float, sensor: Poses, least: float, most: float) -> bool:
        """Whether time, pose (3,) and activations from `least` to `most` can be used."""
        is_finite = all(map(math.isfinite, (t, least, most, *sensor.tolist())))
        if not is_finite or t < self.t:
            return False
        before = self._sensor
        if before is not None and math.dist(before[:2].tolist(), sensor[:2].tolist()) > JUMP_M:
            self._counters.jumps += 1
            self._sensor = sensor  # a far pose at which the sensor stays is believed next time
            return False
        return True


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
