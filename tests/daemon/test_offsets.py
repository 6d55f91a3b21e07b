"""Scans whose sensor, or whose object since, is a little off."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Floats, Poses
from taxeld.estimator.memory import Memory, Slack
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from tests.rig.pressed_box import box_side

SD_M = 0.001
NOISE = Noise(sigma=0.04, gain_cv=0.17)


def presses(model: ObservationModel, n: int, seed: int = 0) -> Poses:
    """(n, 3) of the object in the sensor's frame; each presses well."""
    made = contacts.synthesise(model.scene, 0.04, 0.005, 40 * n, np.random.default_rng(seed)).pose
    return made[model.activation(made).max(axis=1) > 0.4][:n]


def read(model: ObservationModel, press: Poses, off_m: Floats) -> Observation:
    """The object at the origin, and the sensor not quite where it is said to be."""
    sensor = se2.inverse(press)
    z = model.activation(press[None])[0]
    return Observation(
        sensor + np.append(off_m, 0.0), np.where(z < 0.01, 0.0, z), np.ones(len(z), dtype=np.bool_)
    )


def integral(model: ObservationModel, scan: Observation, pose: Poses) -> float:
    """log p(z | pose) over a Gaussian offset, by brute force."""
    step = np.linspace(-4.0, 4.0, 41)
    x, y = (a.ravel() for a in np.meshgrid(step, step))
    weight = np.exp(-0.5 * (x * x + y * y))
    moved = np.stack([SD_M * x, SD_M * y, np.zeros(len(x))], axis=1)
    one = Memory(model, NOISE).plus(replace(scan, sensor=np.zeros(3)))
    seen = se2.compose(se2.inverse(scan.sensor + moved), pose[None])
    likely = one.explain(seen)[:, 0]
    return float(np.log(np.exp(likely - likely.max()) @ weight / weight.sum()) + likely.max())


def test_the_likelihood_is_the_integral_over_all_offsets(box_model: ObservationModel) -> None:
    rng = np.random.default_rng(1)
    off = []
    for press in presses(box_model, 12):
        scan = read(box_model, press, SD_M * rng.standard_normal(2))
        memory = Memory(box_model, NOISE, slack=Slack(SD_M)).plus(scan)
        pose = 5e-4 * rng.standard_normal(3)
        off.append(memory.explain(pose[None])[0, 0] - integral(box_model, scan, pose))
    assert np.median(np.abs(off)) < 0.3
    assert np.max(np.abs(off)) < 1.5


def test_a_touch_that_is_two_millimetres_off_is_explained_with_slack_alone(
    box_model: ObservationModel,
) -> None:
    exact, about = Memory(box_model, NOISE), Memory(box_model, NOISE, slack=Slack(0.002))
    for press in presses(box_model, 6):
        scan = read(box_model, press, np.array([0.002, 0.0]))
        exact, about = exact.plus(scan), about.plus(scan)
    truth = np.zeros((1, 3))
    assert about.explain(truth).sum() > exact.explain(truth).sum() + 20.0


def test_a_place_that_is_known_badly_is_a_scans_own_slack(box_model: ObservationModel) -> None:
    """A touch's and a silent one's; and a scan that is taken from the memory has it still."""
    none, slack = Memory(box_model, NOISE), Memory(box_model, NOISE, slack=Slack(3.0 * SD_M))
    poses = 0.004 * np.random.default_rng(0).standard_normal((20, 3))
    scans = [read(box_model, press, np.zeros(2)) for press in presses(box_model, 3)]
    scans.append(replace(scans[0], z=np.zeros(len(scans[0].z))))
    for scan in scans:
        vague = none.plus(replace(scan, place_sd_m=3.0 * SD_M))
        assert np.allclose(vague.explain(poses), slack.plus(scan).explain(poses))
        assert not np.allclose(vague.explain(poses), none.plus(scan).explain(poses))
        assert vague.plus(scan).scan(0).place_sd_m == pytest.approx(3.0 * SD_M)
        assert np.array_equal(vague.only(vague.link == 0).variance, vague.variance)


def test_without_slack_nothing_changes(box_model: ObservationModel) -> None:
    exact, none = Memory(box_model, NOISE), Memory(box_model, NOISE, slack=Slack(SD_M, SD_M, 0.0))
    for press in presses(box_model, 3):
        scan = read(box_model, press, np.zeros(2))
        exact, none = exact.plus(scan), none.plus(scan)
    poses = 0.002 * np.random.default_rng(0).standard_normal((20, 3))
    assert np.array_equal(exact.explain(poses), none.explain(poses))


def test_an_old_touch_fades_by_what_has_happened_since(box_model: ObservationModel) -> None:
    """An object that gives way at each touch: the same reading says less of where it is now."""
    press = se2.inverse(box_side(box_model, 0.2, 0.003))
    memory = Memory(box_model, NOISE, slack=Slack(0.0, SD_M))
    poses = np.linspace(-0.004, 0.004, 9)[:, None] * np.eye(3)[0]
    spread = []
    memory = memory.plus(read(box_model, press, np.zeros(2)), number=1)
    for newest in (1, 3, 9):
        memory.newest = newest
        spread.append(float(np.ptp(memory.explain(poses))))
    assert spread[0] > 1.5 * spread[1] > 1.5 * 1.2 * spread[2]


@pytest.mark.parametrize("scans", [1, 2, 5])
def test_a_contact_counts_once_however_many_scans_are_of_it(
    box_model: ObservationModel, scans: int
) -> None:
    memory = Memory(box_model, NOISE)
    first, other = (read(box_model, press, np.zeros(2)) for press in presses(box_model, 2))
    for _ in range(scans):
        memory = memory.plus(first, number=1)
    memory = memory.plus(other, number=2)
    assert memory.share[memory.contact].sum() == pytest.approx(2)
    assert np.allclose(memory.share, [1.0 / scans] * scans + [1.0])
    assert np.isclose(memory.share.sum(), 2.0)


def test_a_silent_scan_counts_by_itself(box_model: ObservationModel) -> None:
    memory = Memory(box_model, NOISE)
    press = presses(box_model, 1)[0]
    touch = read(box_model, press, np.zeros(2))
    memory = memory.plus(touch, number=1)
    memory = memory.plus(replace(touch, z=np.zeros_like(touch.z)), number=1)
    assert memory.share[memory.contact].sum() == pytest.approx(1)
    assert np.array_equal(memory.share, [1.0, 1.0])
