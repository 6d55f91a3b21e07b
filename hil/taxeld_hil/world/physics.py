"""Presses and drift of the simulated skin: by the estimator's own model, or a solid against a soft
skin."""

from typing import Protocol

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld_hil.scenario.mesh_config import MeshConfig
from taxeld_hil.world.mesh_skin import MeshSkin
from taxeld_hil.world.soft_skin import CrossTalk, Foam, PerPress, Response, ThermalDrift


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


class MeshPhysics:
    """One skin: what its taxels have drawn for themselves lasts, what a press draws until it ends.

    Foam acts on what a taxel reads of a press before its gain, and cross-talk on counts: recordings
    give both as shares of readings.
    """

    def __init__(
        self,
        config: MeshConfig,
        skin: MeshSkin,
        layout: Layout,
        depth_max_m: float,
        full_scale: Floats,
        rng: np.random.Generator,
    ) -> None:
        """`full_scale` (M,): counts of each taxel at `depth_max_m`; `rng` draws the drift, and a
        generator that it spawns the rest."""
        taxels, own = len(layout), rng.spawn(1)[0]
        self.depth_m: Floats = np.zeros(taxels)  # (M,) the solid's last press, sag included
        self._skin = skin
        self._sag_m = PerPress(config.sag_m, taxels, own)
        self.response = Response(config, taxels, own)
        self._foam = Foam(config, taxels, own)
        self._cross_talk = CrossTalk(layout, config.cross_talk, own)
        self._drift = ThermalDrift(
            taxels, config.drift_counts_per_min, config.drift_period_s, config.drift_cv, rng
        )
        self.full_scale = full_scale
        self._depth_max_m = depth_max_m

    def press(self, seen: Poses, t: float) -> Floats:
        """Like `Physics.press`: `seen` (3,) at t [s] → counts (M,)."""
        was_pressed = self.depth_m.any()
        self.depth_m = self._skin.indentation(seen, self._sag_m.now)
        if was_pressed and not self.depth_m.any():
            self._sag_m.draw()
            self._foam.end()
        reading = self._foam.press(self.response(self.depth_m / self._depth_max_m), t)
        return self._cross_talk.add(self.full_scale * reading)

    def drift(self, t: float) -> tuple[Floats | float, float]:
        counts = self._drift.counts(t)
        return counts * self._drift.share, counts
