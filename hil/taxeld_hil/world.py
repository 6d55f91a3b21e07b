"""The simulated world: an object that stands still, and a skin whose taxels all differ."""

import numpy as np
from numpy.typing import NDArray

from taxeld import se2
from taxeld.observation import ObservationModel
from taxeld.se2 import Poses
from taxeld_hil.scenario import Scenario
from taxeld_protocol.modules import Module

COUNT_MAX = 0xFFFF
T0_COUNTS = 12_000  # of every module's temperature channel, which a press hardly moves
T0_LEAK = 0.02  # share of a press that it sees: 356 of 8 500 counts on a real skin

Floats = NDArray[np.float64]


class World:
    """Counts of a skin at a pose, with baseline, gain spread and noise drawn from a seed.

    It feels what the estimator expects it to feel: `physics = "scene"`.
    """

    def __init__(
        self, scenario: Scenario, model: ObservationModel, modules: list[Module], seed: int
    ) -> None:
        self._rng = np.random.default_rng(seed)
        rng, taxels = self._rng, len(model.layout)
        place = scenario.place_m
        low, high = np.array([-place, -place, -np.pi]), np.array([place, place, np.pi])
        self.truth: Poses = rng.uniform(low, high)
        self._model = model
        self._scenario = scenario
        self._baseline = scenario.baseline_counts + scenario.baseline_spread * _normal(rng, taxels)
        gain = np.maximum(1.0 + scenario.gain_cv * rng.standard_normal(taxels), 0.1)
        self._full_scale = scenario.full_scale_counts * gain
        # the farthest that a taxel touches; a mug's handle is no part of its outline
        corner = np.abs(model.scene.extent).max(axis=0)
        self._reach_m = float(np.hypot(*corner)) + model.layout.radius_m
        index = {int(uid): i for i, uid in enumerate(model.layout.uid)}
        uids = [uid for module in modules for uid in module.uids]
        self._channel_taxel = np.array([index.get(uid, -1) for uid in uids])
        self._channel_module = np.repeat(range(len(modules)), [m.channels for m in modules])

    def counts(self, sensor: Poses, t: float) -> list[int]:
        """One scan, channel by channel, with the sensor at a pose (3,) in the world at t [s]."""
        seen = se2.compose(se2.inverse(sensor), self.truth)
        press = self._press(seen, t)
        drift, t0_drift = self._drift(t)
        noise = self._scenario.noise_counts
        taxels = self._baseline + press + drift + noise * self._rng.standard_normal(len(press))
        at = self._channel_taxel
        felt = np.where(at >= 0, press[at], 0.0)
        leak = np.bincount(self._channel_module, felt)[self._channel_module] * T0_LEAK
        values = np.where(at >= 0, taxels[at], T0_COUNTS + leak + t0_drift)
        return [int(v) for v in np.clip(np.round(values), 1, COUNT_MAX - 1)]

    def _press(self, seen: Poses, _t: float) -> Floats:
        """(M,) counts over the baseline, the object at `seen` (3,) in the sensor frame; quickly
        none where it is out of reach."""
        model = self._model
        if np.hypot(seen[0], seen[1]) > self._reach_m:
            return np.zeros(len(model.layout))
        return np.asarray(self._full_scale * model.activation(seen[None])[0])

    def _drift(self, _t: float) -> tuple[Floats | float, float]:
        """What has come upon the baselines (M,) and upon T0 since the start."""
        return 0.0, 0.0


def world(scenario: Scenario, model: ObservationModel, modules: list[Module], seed: int) -> World:
    """The world with the scenario's physics. The same seed has the same truth, baselines and gains
    in either.

    Raises:
        SetupError: the object has no mesh to be had.
    """
    if scenario.physics == "scene":
        return World(scenario, model, modules, seed)
    from taxeld_hil.mesh_world import MeshWorld  # noqa: PLC0415  # which is a World

    return MeshWorld(scenario, model, modules, seed)


def _normal(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Standard normals within ±3: a baseline must stay a reading."""
    return np.clip(rng.standard_normal(n), -3.0, 3.0)
