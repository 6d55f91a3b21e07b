"""A calibration in use: gains, response and full scale, frozen taxels, the mount, the noise."""

import numpy as np
import pytest

from taxeld.commands.status import lines
from taxeld.config.file import parse
from taxeld.config.tables import Config, FilterConfig, SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.response import GRID, Inverse, response
from taxeld.pipeline.poses import PoseTrack
from taxeld.pipeline.stage import calibrated
from taxeld.skin.skin import Skin
from tests.daemon.test_calibration_file import of
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.stream_page import documented

TEXT = '[scene]\nbundle = "box"\n[source]\nkind = "can"\nchannel = "can0"\n'


def config_of(filter_keys: str = "") -> Config:
    return parse(TEXT + f"[filter]\n{filter_keys}")


def test_a_reading_becomes_the_depth_that_was_pressed(skin: Layout) -> None:
    calibration = of(skin, frozen=np.zeros(len(skin), dtype=bool))
    simulated = SimulatedSkin(skin, noise=0.0)
    subject = Skin(skin, SkinConfig(), calibration=calibration)
    simulated.run(subject, 3.0)
    for depth in (0.2, 0.5, 0.8):
        shape = response(np.full(len(skin), depth), calibration.bend, calibration.onset)
        own = calibration.full_scale_counts * calibration.gain * shape
        rising = shape > 0.1  # an onset that falls below is none of a real taxel
        simulated.press = own
        z = simulated.run(subject, 0.05).z
        assert z[rising] == pytest.approx(depth, abs=0.03)
        simulated.press = np.zeros(len(skin))
        simulated.run(subject, 3.0)


def test_a_response_is_undone_by_its_inverse() -> None:
    onset = np.array([-0.5, 0.0, 0.4, 2.5])
    inverse = Inverse(0.1, onset)
    for h in GRID[::16]:
        reading = response(np.full(4, h), 0.1, onset)
        assert inverse(reading) == pytest.approx(np.full(4, h), abs=4e-3)


@pytest.mark.parametrize("bend", [-0.3, 0.0, 0.1])
def test_a_reading_of_full_scale_is_exactly_full_depth_so_that_it_counts_as_saturated(
    bend: float,
) -> None:
    depth = Inverse(bend, np.linspace(-0.8, 2.5, 50))(np.full(50, 1.7))
    assert (depth == 1.0).all()


def test_without_a_calibration_a_reading_is_a_share_of_full_scale(skin: Layout) -> None:
    simulated = SimulatedSkin(skin, noise=0.0)
    subject = Skin(skin, SkinConfig())
    simulated.run(subject, 3.0)
    simulated.press = np.full(len(skin), 7000.0)
    assert simulated.run(subject, 0.05).z == pytest.approx(0.35, abs=1e-3)


def test_a_taxel_that_was_frozen_when_it_was_calibrated_is_not_believed(skin: Layout) -> None:
    calibration = of(skin)
    subject = Skin(skin, SkinConfig(), calibration=calibration)
    activation = SimulatedSkin(skin, noise=0.3).run(subject, 3.0)
    assert np.flatnonzero(~activation.live).tolist() == [7]
    assert subject.faults()["stuck_taxels"] == [7]


def test_thresholds_are_of_the_calibrations_noise_from_the_first_capture_on(skin: Layout) -> None:
    calibration = of(skin, noise_counts=np.full(len(skin), 60.0))
    subject = Skin(skin, SkinConfig(), calibration=calibration)
    SimulatedSkin(skin, noise=30.0).run(subject, 1.3)
    assert subject.threshold == pytest.approx(360.0, rel=0.02)


def test_the_sensors_pose_is_the_robots_with_the_mount() -> None:
    mount = np.array([0.01, -0.02, 0.3])
    heard: list[tuple[float, ...]] = []
    track = PoseTrack(on_pose=lambda *row: heard.append(row), mount=mount)
    track.add(1.0, 0.1, 0.2, 0.5)
    track.add(1.1, 0.1, 0.2, 0.5)
    assert track.at(1.05) == pytest.approx(se2.compose(np.array([0.1, 0.2, 0.5]), mount))
    assert heard[0] == (1.0, 0.1, 0.2, 0.5)  # what is recorded is what came
    assert track.at(9.0) is None


def test_measured_noise_takes_the_place_of_defaults_and_of_nothing_else(skin: Layout) -> None:
    calibration, usual = of(skin), FilterConfig()
    used = calibrated(config_of(), calibration)
    assert (used.filter.noise_sigma, used.filter.gain_cv) == (0.045, 0.11)
    assert used.skin.full_scale_counts == calibration.full_scale_counts
    assert calibrated(config_of(), None).filter == usual


def test_status_tells_how_old_a_calibration_is() -> None:
    assert "2.5 days old" in _status({"age_s": 2.5 * 86_400.0})
    none = _status({"age_s": -1.0})
    assert "none; full scale and mount are as configured" in none


def _status(calibration: dict[str, object]) -> str:
    _, health = documented("/taxeld/health")
    _, estimate = documented("/taxeld/estimate")
    answer = {"estimate": estimate, "health": health | {"calibration": calibration}}
    found = list(lines(answer | {"waits_for": ""}))
    return next(line for line in found if line.startswith("Calibration"))
