"""Presses and drift of the simulated skin: the interface, and the estimator's own model.

The other kind of physics, a solid against a soft skin, is in `mesh_physics`.
"""

from typing import Protocol

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model.observation import ObservationModel


class Physics(Protocol):
    """Counts that M taxels read over their baselines."""

    def press(self, seen: Poses, t: float) -> Floats:
        """(M,) counts of a press, the object at `seen` (3,) in the sensor frame at t [s]; times do
        not go back."""
        ...

    def drift(self, t: float) -> tuple[Floats | float, float]:
        """Counts by which the baselines (M,) and T0 have drifted since the start."""
        ...


class ScenePhysics:
    """`physics = "scene"`: each taxel reads what the estimator expects of it; nothing drifts."""

    def __init__(self, model: ObservationModel, full_scale: Floats) -> None:
        """`full_scale` (M,): counts of each taxel at full activation."""
        self._model = model
        self.full_scale = full_scale
        # the farthest that a taxel touches; a mug's handle is no part of its outline
        corner = np.abs(model.scene.extent).max(axis=0)
        self._reach_m = float(np.hypot(*corner)) + model.layout.radius_m

    def press(self, seen: Poses, _t: float) -> Floats:
        """Like `Physics.press`: `seen` (3,) → counts (M,)."""
        if np.hypot(seen[0], seen[1]) > self._reach_m:  # most of a path: the model is not asked
            return np.zeros(len(self.full_scale))
        return np.asarray(self.full_scale * self._model.activation(seen[None])[0])

    def drift(self, _t: float) -> tuple[Floats | float, float]:
        return 0.0, 0.0
