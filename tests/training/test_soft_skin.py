"""The soft skins of trials: the harness's figures, and the same laws on activations."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from taxeld.arrays import Floats, Poses
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld_hil.scenario.mesh_config import SKINS as HARNESS
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import electronics
from taxeld_hil.world.mesh_physics import MeshPhysics
from taxeld_training.filters import cells
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.methods import Method
from taxeld_training.filters.soft_skin import SKINS, Figures, SoftSkin
from taxeld_training.filters.trials import Trial
from taxeld_training.objects.setting import Setting, ring

LAYOUT = layouts.load(Scenario("box").layout)
FULL = Scenario("box").full_scale_counts
NONE = (1e-9, 1e-9)
STILL = replace(
    Figures(), sag_m=NONE, bend=0.0, onset=(1.0, 1.0), hysteresis=NONE, residue=NONE,
    residue_slow=NONE, cross_talk=NONE, noise=NONE,
)  # fmt: skip


def skin(figures: Figures, seed: int = 0) -> SoftSkin:
    return SoftSkin(figures, LAYOUT, np.ones(len(LAYOUT)), np.random.default_rng(seed))


def pressed(taxel: int, h: float = 0.8) -> Floats:
    at = np.zeros(len(LAYOUT))
    at[taxel] = h
    return at


@pytest.mark.parametrize("name", SKINS)
def test_a_skin_has_the_harnesss_figures(name: str) -> None:
    ours, theirs = asdict(SKINS[name]), asdict(HARNESS[name])
    noise = ours.pop("noise")
    assert {key: theirs[key] for key in ours} == ours
    assert noise == pytest.approx([counts / FULL for counts in theirs["noise_counts"]])


def test_with_nothing_amiss_the_true_activation_is_read() -> None:
    h = np.random.default_rng(0).uniform(0.0, 1.0, len(LAYOUT))
    z, felt = skin(STILL).read(h, 0.0)
    np.testing.assert_allclose(z, h, atol=1e-6)
    assert (felt == (h > 0.01)).all()


def test_responses_are_the_harnesss() -> None:
    h = np.linspace(0.0, 1.0, len(LAYOUT))
    z, _ = skin(replace(STILL, bend=0.065, onset=(1.5, 1.5))).read(h, 0.0)
    expected = electronics.mean_response(h, 0.065) + 0.5 * electronics.deviation(h)
    np.testing.assert_allclose(z, expected, atol=1e-6)


def test_sag_falls_with_distance_and_cross_talk_ends_at_the_module() -> None:
    z, _ = skin(replace(STILL, sag_m=(0.006, 0.006))).read(pressed(24), 0.0)
    apart = np.linalg.norm(LAYOUT.position_m - LAYOUT.position_m[24], axis=1)
    np.testing.assert_allclose(z, 0.8 * np.exp(-apart / 0.006), atol=1e-6)
    z, _ = skin(replace(STILL, cross_talk=(0.03, 0.03))).read(pressed(24), 0.0)
    np.testing.assert_allclose(np.delete(z[20:30], 4), 0.024, atol=1e-6)
    np.testing.assert_allclose(np.delete(z, np.s_[20:30]), 0.0, atol=1e-6)


def test_what_stays_of_a_press_is_read_and_fades() -> None:
    keeps = skin(replace(STILL, residue=(0.05, 0.05), residue_slow=(0.02, 0.02)))
    for t in np.arange(0.0, 10.0, 0.05):
        keeps.read(pressed(24), t)
    left = [keeps.read(np.zeros(len(LAYOUT)), 9.95 + t)[0][24] for t in (0.0, 1.0, 30.0)]
    fading = [0.07, 0.05 * np.exp(-1.0) + 0.02 * np.exp(-1.0 / 30.0), 0.02 * np.exp(-1.0)]
    np.testing.assert_allclose(left, 0.8 * np.array(fading), rtol=0.02)


class Pressed:
    """Depths, given for each step, in place of a solid's."""

    def __init__(self, depth_m: Floats) -> None:
        self.depth_m = depth_m

    def indentation(self, seen: Poses, _sag_m: Floats) -> Floats:
        return np.asarray(self.depth_m[int(seen[0])])


def test_presses_are_read_as_the_harness_reads_them() -> None:
    """Whatever is drawn is given, and sag is off, which is a solid's there: then response, loop,
    residues and cross-talk are the same, press after press, scan by scan."""
    figures = replace(
        Figures(), sag_m=NONE, onset=(1.5, 1.5), hysteresis=(0.03, 0.03), residue=(0.02, 0.02),
        residue_slow=(0.05, 0.05), cross_talk=(0.03, 0.03), noise=NONE,
    )  # fmt: skip
    same = asdict(figures)
    del same["noise"]
    rng, taxels = np.random.default_rng(0), len(LAYOUT)
    h = np.repeat(rng.uniform(0.0, 1.0, (40, taxels)), 5, axis=0)
    h[np.repeat(rng.random((40, taxels)) < 0.8, 5, axis=0)] = 0.0
    h[np.repeat(np.arange(40) % 4 == 3, 5)] = 0.0  # nothing is touched in every fourth
    ours, depth_max_m = skin(figures), 0.005
    theirs = MeshPhysics(
        replace(HARNESS["typical"], **same), Pressed(depth_max_m * h), LAYOUT, depth_max_m,  # type: ignore[arg-type]
        np.full(taxels, FULL), rng,
    )  # fmt: skip
    for k, pressed_by in enumerate(h):
        z, _ = ours.read(pressed_by, 0.05 * k)
        counts = theirs.press(np.array([k, 0.0, 0.0]), 0.05 * k)
        np.testing.assert_allclose(z, counts / FULL, atol=1e-6)


@pytest.mark.parametrize("name", SKINS)
def test_while_nothing_is_touched_no_reading_rises(name: str) -> None:
    """But for noise."""
    rng = np.random.default_rng(1)
    for seed in range(20):
        of = skin(replace(SKINS[name], noise=NONE), seed)
        for k in range(20):
            h = np.where(rng.random(len(LAYOUT)) < 0.2, rng.uniform(0.0, 1.0, len(LAYOUT)), 0.0)
            of.read(h, 0.1 * k)
        z = np.array([of.read(np.zeros(len(LAYOUT)), 2.0 + 0.1 * k)[0] for k in range(60)])
        assert np.diff(z, axis=0).max() <= 1e-7


@pytest.mark.parametrize("name", SKINS)
def test_trials_run_on_a_soft_skin_and_its_name_is_part_of_their_cells(
    name: str, ring_model: ObservationModel
) -> None:
    found = [m.activation.z for m in Trial(ring_model, 3, 2, Conditions(skin=name))]
    plain = [m.activation.z for m in Trial(ring_model, 3, 2)]
    assert len(found) == len(plain)
    assert not np.array_equal(np.array(found), np.array(plain))
    again = [m.activation.z for m in Trial(ring_model, 3, 2, Conditions(skin=name))]
    np.testing.assert_array_equal(found, again)
    setting = Setting("025_mug", ring(16), 16)
    cell = cells.Cell(setting, Method("table", "mixture"), Conditions(skin=name))
    assert f"skin={name}" in cell.name
