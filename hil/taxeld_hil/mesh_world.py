"""The world with `physics = "mesh"`: a solid against a soft skin, and the skin's own vices."""

import json

import numpy as np

from taxeld import bundle
from taxeld.layout import Layout
from taxeld.observation import ObservationModel
from taxeld.se2 import Poses
from taxeld_hil import meshes
from taxeld_hil.electronics import Foam, Warmth, condenser, coupling
from taxeld_hil.mesh_skin import LAYER_M, MARGIN_M, MeshSkin
from taxeld_hil.scenario import Scenario
from taxeld_hil.solids import Solid
from taxeld_hil.world import Floats, World
from taxeld_protocol.modules import Module


def solid_of(name: str, layout: Layout) -> Solid:
    """The solid that the bundle `name` was made of, at the bundle's height.

    Raises:
        SetupError: there is no mesh of it here.
    """
    info = json.loads((bundle.find(name) / "bundle.json").read_text(encoding="utf-8"))
    height = float(info["height_m"])
    reach = float(np.abs(layout.position_m[:, 2]).max()) + MARGIN_M + LAYER_M
    return meshes.load(str(info["object"]), height, reach)


class MeshWorld(World):
    """A skin that feels the solid itself, remembers, couples and drifts."""

    def __init__(
        self, scenario: Scenario, model: ObservationModel, modules: list[Module], seed: int
    ) -> None:
        super().__init__(scenario, model, modules, seed)
        config, layout = scenario.mesh, model.layout
        solid = solid_of(scenario.bundle, layout)
        self._skin = MeshSkin(solid, layout, config.taxel_radius_m, config.sag_m)
        self._foam = Foam(len(layout), config.hysteresis, config.creep, config.creep_s)
        self._coupling = coupling(layout, config.cross_talk)
        self._warmth = Warmth(len(layout), config.drift_counts_per_min, config.drift_period_s,
                              config.drift_cv, self._rng)  # fmt: skip
        self._depth_max_m = model.depth_max_m
        self._closing = config.closing

    def _press(self, seen: Poses, t: float) -> Floats:
        depth = self._foam.press(self._skin.indentation(seen), t)
        h = condenser(depth / self._depth_max_m, self._closing)
        return np.asarray(self._coupling @ (self._full_scale * h))

    def _drift(self, t: float) -> tuple[Floats | float, float]:
        counts = self._warmth.counts(t)
        return counts * self._warmth.share, counts
