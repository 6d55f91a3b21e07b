"""A solid against a soft skin: its geometry, the taxels' responses, foam, cross-talk and drift."""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld_hil.scenario.mesh_config import MeshConfig
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.electronics import CrossTalk, Response, ThermalDrift
from taxeld_hil.world.foam import Foam
from taxeld_hil.world.mesh_skin import MeshSkin
from taxeld_hil.world.spread import PerPress


def of_scenario(
    scenario: Scenario, model: ObservationModel, full_scale: Floats, rng: np.random.Generator
) -> "MeshPhysics":
    """The scenario's object against its skin, whose taxels read `full_scale` (M,) [counts].

    Raises:
        SetupError: the object's mesh cannot be found or read.
    """
    solid = solid_of(scenario.bundle, model.layout)
    radius_m, depth_m = scenario.skin.taxel_radius_m, model.depth_max_m
    cover = MeshSkin(solid, model.layout, radius_m, depth_max_m=depth_m)
    return MeshPhysics(scenario.skin, cover, model.layout, model.depth_max_m, full_scale, rng)


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
