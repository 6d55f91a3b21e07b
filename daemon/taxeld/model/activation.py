"""What a skin reads at one moment."""

from dataclasses import dataclass

from taxeld.arrays import Bools, Floats

FLOOR = 0.01  # of full scale: a lighter touch does not constrain the pose


@dataclass(frozen=True, slots=True)
class Activation:
    """What M taxels read at time t."""

    t: float
    z: Floats  # (M,) 0..1, exactly 0 below the taxel's floor
    live: Bools  # (M,) whether the taxel has answered and can be believed
    floor: Floats | float = FLOOR  # (M,) under which a reading is 0: noise, and what foam kept
    residue: Floats | float = 0.0  # (M,) of presses before, that a reading may have in it
