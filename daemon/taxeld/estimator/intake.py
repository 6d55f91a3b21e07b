"""What can be used of a scan: finite, in order, within its range, without taxels that are stuck,
and not what may come from presses elsewhere."""

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
    """Makes observations of one skin's activations; what is wrong with them is counted."""

    def __init__(self, model: ObservationModel, counters: EstimatorCounters) -> None:
        self.t = -np.inf  # of the last scan that was used
        self._counters = counters
        self._radius_m = model.layout.radius_m
        self._leak = model.leak
        self._sensor: Poses | None = None
        self._stuck = Stuck(len(model.layout))

    def observation(self, activation: Activation, sensor: Poses) -> Observation | None:
        """A scan at the sensor's pose (3,) in the world as evidence; None: it is of no use."""
        a, least, most = activation, float(activation.z.min()), float(activation.z.max())
        if not self._is_usable(a.t, sensor, least, most):
            return None
        before, self._sensor, self.t = self._sensor, sensor, a.t
        if least == most == 0.0:  # as mostly: nothing is stuck, and nothing leaks
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
        """Activations from `least` to `most`."""
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
            self._sensor = sensor  # where it stays, it is believed
            return False
        counters.out_of_range += least < 0.0 or most > 1.0
        return True
