"""A calibration in use: gains, response and full scale, frozen taxels, the mount, the noise."""

import numpy as np
import pytest

from taxeld.config.file import parse
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.response import GRID, Inverse, response
from taxeld.pipeline.poses import PoseTrack
from taxeld.pipeline.stage import calibrated
from taxeld.skin.skin import Skin
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.skins import calibration_of

TEXT = '[scene]\nbundle = "box"\n[source]\nkind = "can"\nchannel = "can0"\n'


@pytest.mark.parametrize("depth", [0.2, 0.5, 0.8])
def test_a_reading_becomes_the_depth_that_was_pressed(skin: Layout, depth: float) -> None:
    c = calibration_of(skin, frozen=np.zeros(len(skin), dtype=bool))
    simulated, subject = SimulatedSkin(skin, noise=0.0), Skin(skin, SkinConfig(), calibration=c)
    simulated.run(subject, 3.0)
    shape = response(np.full(len(skin), depth), c.bend, c.onset)
    rising = shape > 0.1  # an onset that falls below is none of a real taxel
    simulated.press = c.full_scale_counts * c.gain * shape
    assert simulated.run(subject, 0.05).z[rising] == pytest.approx(depth, abs=0.03)


@pytest.mark.parametrize("bend", [-0.3, 0.0, 0.1])
def test_a_response_is_undone_by_its_inverse_and_full_scale_is_exactly_full_depth(
    bend: float,
) -> None:
    """So that a reading of full scale counts as saturated."""
    onset = np.array([-0.5, 0.0, 0.4, 2.5])
    inverse = Inverse(bend, onset)
    assert (inverse(np.full(4, 1.7)) == 1.0).all()
    rising = np.diff(response(GRID, bend, onset[:, None]), axis=1).min(axis=1) > 0.0
    for h in GRID[::16]:
        reading = response(np.full(4, h), bend, onset)
        assert inverse(reading)[rising] == pytest.approx(h, abs=4e-3)


def test_taxels_have_the_calibrations_noise_and_the_frozen_ones_are_not_believed(
    skin: Layout,
) -> None:
    calibration = calibration_of(skin, noise_counts=np.full(len(skin), 60.0))
    subject = Skin(skin, SkinConfig(), calibration=calibration)
    activation = SimulatedSkin(skin).run(subject, 1.3)
    assert subject.threshold == pytest.approx(360.0, rel=0.02)
    assert np.flatnonzero(~activation.live).tolist() == subject.faults()["stuck_taxels"] == [7]


def test_the_sensors_pose_is_the_robots_with_the_mount() -> None:
    mount = np.array([0.01, -0.02, 0.3])
    heard: list[tuple[float, ...]] = []
    track = PoseTrack(on_pose=lambda *row: heard.append(row), mount=mount)
    for t in (1.0, 1.1):
        track.add(t, 0.1, 0.2, 0.5)
    assert track.at(1.05) == pytest.approx(se2.compose(np.array([0.1, 0.2, 0.5]), mount))
    assert heard[0] == (1.0, 0.1, 0.2, 0.5)  # what is recorded is what came
    assert track.at(9.0) is None


def test_measured_noise_takes_the_place_of_defaults_and_of_nothing_else(skin: Layout) -> None:
    calibration, usual = calibration_of(skin), FilterConfig()
    used = calibrated(parse(TEXT), calibration)
    assert (used.filter.noise_sigma, used.filter.gain_cv) == (0.045, 0.11)
    assert used.skin.full_scale_counts == calibration.full_scale_counts
    assert calibrated(parse(TEXT), None).filter == usual
