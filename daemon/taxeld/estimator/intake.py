"""The usable part of a scan: finite, in order, in range, without stuck taxels or leaked presses."""

import math

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.counters import EstimatorCounters
from taxeld.estimator.news import moved_m
from taxeld.estimator.stuck import Stuck
from taxeld.model.activation import Activation
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.se2 import JUMP_M


class Intake:
    """Makes observations of one skin's activations, and counts the faults in them."""

    def __init__(self, model: ObservationModel, counters: EstimatorCounters) -> None:
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
            return Observation(sensor, a.z, a.live, a.floor, a.residue)
        moved = 0.0 if before is None else moved_m(before, sensor, self._radius_m)
        z = np.clip(activation.z, 0.0, 1.0)
        stuck = self._stuck.on_scan(z, moved) & activation.live
        self._counters.stuck += bool(stuck.any())
        live = activation.live & ~stuck
        z, floor, residue = self._leak.without(
            np.where(live, z, 0.0), activation.floor, activation.residue
        )
        return Observation(sensor, z, live, floor, residue)

    def _is_usable(self, t: float, sensor: Poses, least: float, most: float) -> bool:
        """Whether time, pose (3,) and activations from `least` to `most` can be used."""
        counters = self._counters
        if not all(map(math.isfinite, (t, least, most, *sensor.tolist()))):
            counters.bad_input += 1
            return False
        if t < self.t:
            counters.back_in_time += 1
            return False
        before = self._sensor
        if before is not None and math.dist(before[:2].tolist(), sensor[:2].tolist()) > JUMP_M:
            counters.jumps += 1
            self._sensor = sensor  # a far pose at which the sensor stays is believed next time
            return False
        counters.out_of_range += least < 0.0 or most > 1.0
        return True
