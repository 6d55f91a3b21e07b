"""What a skin reads at one moment."""

from dataclasses import dataclass

from taxeld.arrays import Bools, Floats


@dataclass(frozen=True, slots=True)
class Activation:
    """What M taxels read at time t."""

    t: float
    z: Floats  # (M,) 0..1, exactly 0 below the taxel's threshold
    live: Bools  # (M,) whether the taxel has answered and can be believed
