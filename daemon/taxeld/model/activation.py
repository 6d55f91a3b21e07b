"""A skin's activations at one moment."""

from dataclasses import dataclass

from taxeld.arrays import Bools, Floats
from taxeld.model.noise import FLOOR, Noise


@dataclass(frozen=True, slots=True)
class Activation:
    """Readings of M taxels at time t [s]."""

    t: float
    z: Floats  # (M,) 0..1, exactly 0 below the taxel's floor
    live: Bools  # (M,) whether the taxel has answered and can be believed
    floor: Floats | float = FLOOR  # (M,) readings below it are 0: noise, and foam's remains
    residue: Floats | float = 0.0  # (M,) part of a reading that earlier presses may have left
    noise: Noise | None = None  # errors of each taxel, where they are known
    place_sd_m: float = 0.0  # of the sensor's place at t, beside what every place is off
