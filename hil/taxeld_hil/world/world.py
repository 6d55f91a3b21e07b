"""The simulated world: an object that stands still, and a skin whose taxels all differ."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats, Poses
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import bundled
from taxeld_hil.world.mesh_skin import MeshSkin
from taxeld_hil.world.physics import MeshPhysics, Physics, ScenePhysics
from taxeld_hil.world.soft_skin import drawn
from taxeld_protocol.modules import Module

COUNT_MAX = 0xFFFF
T0_COUNTS = 12_000  # level of every module's temperature channel; a press hardly moves it
T0_LEAK = 0.02  # share of a press that it reads: 356 of 8 500 counts on a real skin


def load_model(scenario: Scenario) -> ObservationModel:
    """The skin and the object of a scenario, as the daemon has them.

    Raises:
        SetupError: either cannot be loaded.
    """
    return bundled.on_layout(scenario.bundle, scenario.skin_layout).model


class Channels:
    """Which taxel and which module each channel of a scan reads."""

    def __init__(self, layout: Layout, modules: Sequence[Module]) -> None:
        index = {int(uid): i for i, uid in enumerate(layout.uid)}
        uids = [uid for module in modules for uid in module.uids]
        self.taxel = np.array([index.get(uid, -1) for uid in uids])  # -1: no taxel, but T0
        self.module = np.repeat(range(len(modules)), [m.channels for m in modules])


@dataclass(slots=True)
class World:
    """The object's pose, and the counts of M taxels wherever the sensor is."""

    truth: Poses  # (3,) of the object
    baseline: Floats  # (M,) counts of the untouched skin
    noise_counts: Floats  # (M,) sd of a reading
    physics: Physics
    channels: Channels
    rng: np.random.Generator  # draws the noise

    def counts(self, sensor: Poses, t: float) -> list[int]:
        """One scan, channel by channel, with the sensor at a pose (3,) in the world at t [s]."""
        seen = se2.compose(se2.inverse(sensor), self.truth)
        press = self.physics.press(seen, t)
        drift, t0_drift = self.physics.drift(t)
        noise = self.noise_counts * self.rng.standard_normal(len(press))
        taxels = self.baseline + press + drift + noise
        at, module = self.channels.taxel, self.channels.module
        pressed = np.where(at >= 0, press[at], 0.0)
        leak = np.bincount(module, pressed)[module] * T0_LEAK
        values = np.where(at >= 0, taxels[at], T0_COUNTS + leak + t0_drift)
        return [int(v) for v in np.clip(np.round(values), 1, COUNT_MAX - 1)]


def make_world(
    scenario: Scenario, model: ObservationModel, modules: Sequence[Module], seed: int
) -> World:
    """The scenario's world, drawn from the seed: truth, baselines, gains, then what the physics and
    the noise draw. So a seed has the same truth and baselines on every skin, and gains that differ
    by their spread alone; and what a skin draws beside comes from generators of its own.

    Raises:
        SetupError: the object's mesh cannot be found or read.
    """
    rng, taxels = np.random.default_rng(seed), len(model.layout)
    truth = placed(scenario, rng)
    baseline = scenario.baseline_counts + scenario.baseline_spread * _normal(rng, taxels)
    skin = scenario.skin
    gain = np.maximum(1.0 + skin.gain_cv * rng.standard_normal(taxels), 0.1)
    full_scale = scenario.full_scale_counts * gain
    noise = drawn(skin.noise_counts, rng.spawn(1)[0].standard_normal(taxels))
    physics: Physics = ScenePhysics(model, full_scale)
    if scenario.physics != "scene":
        solid = bundled.solid_of(scenario.bundle, model.layout)
        cover = MeshSkin(solid, model.layout, skin.taxel_radius_m, model.depth_max_m)
        physics = MeshPhysics(skin, cover, model.layout, model.depth_max_m, full_scale, rng)
    channels = Channels(model.layout, modules)
    return World(truth, baseline, noise, physics, channels, rng)


def placed(scenario: Scenario, rng: np.random.Generator) -> Poses:
    """Where the object stands (3,)."""
    most = np.array([scenario.place_m, scenario.place_m, np.pi])
    return rng.uniform(-most, most)


def _normal(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Standard normals within ±3: a baseline must stay a reading."""
    return np.clip(rng.standard_normal(n), -3.0, 3.0)
