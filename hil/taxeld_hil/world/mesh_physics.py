"""`physics = "mesh"`: a solid against a soft skin, with the skin's hysteresis, creep and drift."""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.proposals import bundle, manifest, seal
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import meshes
from taxeld_hil.world.electronics import Foam, ThermalDrift, condenser, coupling
from taxeld_hil.world.mesh_skin import LAYER_M, MARGIN_M, MeshSkin
from taxeld_hil.world.solids import Solid


def solid_of(name: str, layout: Layout) -> Solid:
    """The solid that the bundle `name` was made of, at the bundle's height.

    Raises:
        SetupError: the bundle is damaged, or its mesh cannot be found or read.
    """
    path = bundle.find(name) / manifest.NAME
    info = manifest.parse(seal.read(path), path)
    height = float(info["height_m"])
    reach = float(np.abs(layout.position_m[:, 2]).max()) + MARGIN_M + LAYER_M
    return meshes.load(str(info["object"]), height, reach)


class MeshPhysics:
    """Depths by the solid's geometry, then foam, condenser, gains, cross-talk; and temperature."""

    def __init__(
        self,
        scenario: Scenario,
        model: ObservationModel,
        full_scale: Floats,
        rng: np.random.Generator,
    ) -> None:
        """`full_scale` (M,): counts of each taxel at full depth; `rng` draws the drift.

        Raises:
            SetupError: the object's mesh cannot be found or read.
        """
        config, layout = scenario.mesh, model.layout
        solid = solid_of(scenario.bundle, layout)
        self._skin = MeshSkin(solid, layout, config.taxel_radius_m, config.sag_m)
        self._foam = Foam(len(layout), config.hysteresis, config.creep, config.creep_s)
        self._coupling = coupling(layout, config.cross_talk)
        self._drift = ThermalDrift(len(layout), config.drift_counts_per_min, config.drift_period_s,
                              config.drift_cv, rng)  # fmt: skip
        self._full_scale = full_scale
        self._depth_max_m = model.depth_max_m
        self._closing = config.closing

    def press(self, seen: Poses, t: float) -> Floats:
        depth = self._foam.press(self._skin.indentation(seen), t)
        h = condenser(depth / self._depth_max_m, self._closing)
        return np.asarray(self._coupling @ (self._full_scale * h))

    def drift(self, t: float) -> tuple[Floats | float, float]:
        counts = self._drift.counts(t)
        return counts * self._drift.share, counts
