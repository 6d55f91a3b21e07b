"""The interface of all samplers of poses that explain a touch."""

from typing import Protocol

import numpy as np

from taxeld.arrays import Bools, Floats, Poses


class Proposal(Protocol):
    """A sampler of p(pose | activations)."""

    @property
    def name(self) -> str: ...

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """z (M,), live (M,) → object poses (n, 3) in the sensor frame."""
        ...
