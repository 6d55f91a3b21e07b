"""What a sure belief tells a skin about its taxels."""

from typing import NamedTuple

from taxeld.arrays import Bools, Floats


class Lesson(NamedTuple):
    """Readings of K contacts beside the depths that a belief expects, (K, M) each, in shares of
    full scale."""

    z: Floats  # by the curves in use; 0 under the floor
    floor: Floats  # of readings of 0
    h: Floats  # expected depth, with sag
    by_sag: Floats  # slope of h over the logarithm of the sag's length
    variance: Floats  # of the depth about h, by pose, and of what earlier presses may have left
    live: Bools
