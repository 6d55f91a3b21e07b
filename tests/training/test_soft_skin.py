"""The soft skins of trials: the harness's laws on activations."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Floats, Poses
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld_hil.scenario.mesh_config import PLAIN, SKINS, TYPICAL, MeshConfig
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.mesh_physics import MeshPhysics
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.soft_skin import SoftSkin
from taxeld_training.filters.trials import Trial

LAYOUT = layouts.load(Scenario("box").layout)
FULL = Scenario("box").full_scale_counts
TAXELS = len(LAYOUT)
LITTLE = (1e-9, 1e-9)  # of a length, in place of 0
STILL = replace(PLAIN, sag_m=LITTLE, noise_counts=LITTLE)


def skin(config: MeshConfig, seed: int = 0) -> SoftSkin:
    return SoftSkin(config, LAYOUT, np.ones(TAXELS), np.random.default_rng(seed))


def test_with_nothing_amiss_the_true_activation_is_read() -> None:
    h = np.random.default_rng(0).uniform(0.0, 1.0, TAXELS)
    z, felt = skin(STILL).read(h, 0.0)
    np.testing.assert_allclose(z, h, atol=1e-6)
    assert (felt == (h > 0.01)).all()


def test_the_cover_sags_less_with_distance() -> None:
    pressed = np.where(np.arange(TAXELS) == 24, 0.8, 0.0)
    z, _ = skin(replace(STILL, sag_m=(0.006, 0.006))).read(pressed, 0.0)
    apart = np.linalg.norm(LAYOUT.position_m - LAYOUT.position_m[24], axis=1)
    np.testing.assert_allclose(z, 0.8 * np.exp(-apart / 0.006), atol=1e-6)


class Pressed:
    """Depths, given for each step, in place of a solid's."""

    def __init__(self, depth_m: Floats) -> None:
        self.depth_m = depth_m

    def indentation(self, seen: Poses, _sag_m: Floats) -> Floats:
        return np.asarray(self.depth_m[int(seen[0])])


def test_presses_are_read_as_the_harness_reads_them() -> None:
    """Whatever is drawn is given, and sag is off, which is a solid's there: then response, loop,
    residues and cross-talk are the same, press after press, scan by scan."""
    config = replace(
        TYPICAL, sag_m=LITTLE, onset=(1.5, 1.5), hysteresis=(0.03, 0.03), residue=(0.02, 0.02),
        residue_slow=(0.05, 0.05), cross_talk=(0.03, 0.03), noise_counts=LITTLE,
    )  # fmt: skip
    rng = np.random.default_rng(0)
    h = np.repeat(rng.uniform(0.0, 1.0, (40, TAXELS)), 5, axis=0)
    h[np.repeat(rng.random((40, TAXELS)) < 0.8, 5, axis=0)] = 0.0
    h[np.repeat(np.arange(40) % 4 == 3, 5)] = 0.0  # nothing is touched in every fourth
    ours, depth_max_m = skin(config), 0.005
    theirs = MeshPhysics(
        config,
        Pressed(depth_max_m * h),
        LAYOUT,
        depth_max_m,
        np.full(TAXELS, FULL),
        rng,  # type: ignore[arg-type]
    )
    for k, pressed in enumerate(h):
        z, _ = ours.read(pressed, 0.05 * k)
        counts = theirs.press(np.array([k, 0.0, 0.0]), 0.05 * k)
        np.testing.assert_allclose(z, counts / FULL, atol=1e-6)


@pytest.mark.parametrize("name", SKINS)
def test_trials_run_on_each_of_the_harnesss_skins(name: str, ring_model: ObservationModel) -> None:
    found, again = (
        np.array([m.activation.z for m in Trial(ring_model, 3, 2, Conditions(skin=name))])
        for _ in range(2)
    )
    plain = np.array([m.activation.z for m in Trial(ring_model, 3, 2)])
    assert found.shape == plain.shape
    assert not np.array_equal(found, plain)
    np.testing.assert_array_equal(found, again)
