"""What can be used of a scan: finite, in order, within its range, without taxels that are stuck,
and not what may come from presses elsewhere."""

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
        if not self._is_usable(activation, sensor):
            return None
        before, self._sensor, self.t = self._sensor, sensor, activation.t
        moved = 0.0 if before is None else moved_m(before, sensor, self._radius_m)
        z = np.clip(activation.z, 0.0, 1.0)
        stuck = self._stuck.on_scan(z, moved) & activation.live
        self._counters.stuck += bool(stuck.any())
        live = activation.live & ~stuck
        z, floor, residue = self._leak.without(
            np.where(live, z, 0.0), activation.floor, activation.residue
        )
        return Observation(sensor, z, live, floor, residue)

    def _is_usable(self, activation: Activation, sensor: Poses) -> bool:
        counters, t, z = self._counters, activation.t, activation.z
        if not (np.isfinite(z).all() and np.isfinite(sensor).all() and np.isfinite(t)):
            counters.bad_input += 1
            return False
        if t < self.t:
            counters.back_in_time += 1
            return False
        if self._sensor is not None and moved_m(self._sensor, sensor, 0.0) > JUMP_M:
            counters.jumps += 1
            self._sensor = sensor  # where it stays, it is believed
            return False
        counters.out_of_range += bool(z.min() < 0.0 or z.max() > 1.0)
        return True
