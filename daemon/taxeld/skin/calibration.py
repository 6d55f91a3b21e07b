"""What a calibration tells of one skin on one robot, and readings of it."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.response import Inverse

DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Calibration:
    """M taxels; each sd is one standard deviation. `t` is when it was measured, in Unix seconds."""

    t: float
    digest: str  # of the taxels' places and UIDs, as `skin.state` has it
    object: str  # what was pressed
    presses: int
    full_scale_depth_m: float
    full_scale_counts: float  # at that depth, of a taxel whose gain is 1
    full_scale_sd: float  # relative
    bend: float  # of the common response
    bend_sd: float
    mount: Poses  # (3,) the sensor's frame in the frame that the robot tells of
    mount_sd: Floats
    noise_sigma: float  # of an activation about what is expected of it, and
    gain_cv: float  # of its share in that
    gain: Floats  # (M,)
    gain_sd: Floats  # (M,) relative; of one that was not touched enough, the fleet's spread
    onset: Floats  # (M,) of its own response
    onset_sd: Floats
    noise_counts: Floats  # (M,) of a reading at rest
    frozen: Bools  # (M,) never changed

    def age_days(self, now: float) -> float:
        """At a Unix time [s]."""
        return (now - self.t) / DAY_S


class Scale:
    """Counts over baseline → activations: by one full scale, or as a calibration has it."""

    def __init__(self, full_scale_counts: float, own: Floats | float, inverse: Inverse | None):
        """`own` (M,): counts of each taxel at full depth."""
        self.full_scale_counts = full_scale_counts
        self._own = own
        self._inverse = inverse

    @classmethod
    def of(cls, own: Floats, inverse: Inverse) -> Self:
        return cls(float(np.median(own)), own, inverse)

    @classmethod
    def used(cls, full_scale_counts: float, calibration: Calibration | None) -> Self:
        """By the configured full scale, or by a calibration in its place."""
        if calibration is None:
            return cls(full_scale_counts, full_scale_counts, None)
        c = calibration
        return cls(c.full_scale_counts, c.full_scale_counts * c.gain, Inverse(c.bend, c.onset))

    def activation(self, over: Floats) -> Floats:
        """(M,) in 0..1, of counts (M,) over baseline."""
        reading = np.minimum(np.maximum(over / self._own, 0.0), 1.0)
        return reading if self._inverse is None else self._inverse(reading)
