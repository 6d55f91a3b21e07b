"""The calibration of one skin on one robot, and the scale from counts to activations."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.response import Inverse

DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Calibration:
    """Measured values of M taxels; each sd is one standard deviation."""

    t: float
    digest: str  # digest of the taxels' places and UIDs (`skin.state.digest`)
    object: str  # name of the object that was pressed
    presses: int
    full_scale_depth_m: float
    full_scale_counts: float  # counts at that depth of a taxel whose gain is 1
    full_scale_sd: float  # relative sd
    bend: float  # bend of the common response (`model.response`)
    bend_sd: float
    mount: Poses  # (3,) sensor's frame in the frame of the robot's poses
    mount_sd: Floats
    noise_sigma: float  # sd of an activation about the expected one: constant part
    gain_cv: float  # sd of an activation in proportion to it, beside noise_sigma
    gain: Floats  # (M,) relative gain of each taxel
    gain_sd: Floats  # (M,) relative; the fleet's spread for a taxel that was touched too little
    onset: Floats  # (M,) onset of the taxel's own response (`model.response`)
    onset_sd: Floats
    noise_counts: Floats  # (M,) sd of a reading at rest
    frozen: Bools  # (M,) taxels that never changed

    def age_days(self, now: float) -> float:
        """Age at Unix time `now` [s]."""
        return (now - self.t) / DAY_S


class Scale:
    """Counts over baseline → activations: by one full scale, or by a calibration."""

    def __init__(self, full_scale_counts: float, own: Floats | float, inverse: Inverse | None):
        """`own` (M,) or one number: counts of each taxel at full depth."""
        self.full_scale_counts = full_scale_counts
        self._own = own
        self._inverse = inverse

    @classmethod
    def of(cls, own: Floats, inverse: Inverse) -> Self:
        """The scale for counts `own` (M,) of each taxel at full depth."""
        return cls(float(np.median(own)), own, inverse)

    @classmethod
    def used(cls, full_scale_counts: float, calibration: Calibration | None) -> Self:
        """The scale of the configured full scale, or of a calibration in its place."""
        if calibration is None:
            return cls(full_scale_counts, full_scale_counts, None)
        c = calibration
        return cls(c.full_scale_counts, c.full_scale_counts * c.gain, Inverse(c.bend, c.onset))

    def activation(self, over: Floats) -> Floats:
        """Activations (M,) in 0..1 of counts (M,) over baseline."""
        reading = np.minimum(np.maximum(over / self._own, 0.0), 1.0)
        return reading if self._inverse is None else self._inverse(reading)
