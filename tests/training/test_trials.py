"""Trials: the same touches for a seed, and each condition changes what it names and no more."""

from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from taxeld.advice.advice import Approach
from taxeld.advice.lines import FELT_M
from taxeld.arrays import Floats, Poses
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld_hil.scenario.mesh_config import PLAIN, SKINS, TYPICAL, MeshConfig
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.physics import MeshPhysics
from taxeld_training.filters import trials
from taxeld_training.filters.conditions import (
    SIDE_RAD,
    TWIN_GAP_M,
    SoftSkin,
    TrialConditions,
    TrialSkin,
    Twin,
)
from taxeld_training.filters.trials import Trial, TrialScan

from .rig import gap_m

TOUCHES = 6
LAYOUT = layouts.load(Scenario("box").skin_layout)
FULL = Scenario("box").full_scale_counts
TAXELS = len(LAYOUT)
LITTLE = (1e-9, 1e-9)  # of a length, in place of 0
STILL = replace(PLAIN, sag_m=LITTLE, noise_counts=LITTLE)


def moments(model: ObservationModel, seed: int = 3, **given: float) -> list[TrialScan]:
    conditions = replace(TrialConditions(), **given)  # type: ignore[arg-type]
    return list(Trial(model, seed, TOUCHES, conditions))


def by_touch(found: list[TrialScan]) -> list[list[TrialScan]]:
    return [list(each) for _, each in groupby(found, key=lambda m: m.touch)]


def true_pose(moment: TrialScan) -> NDArray[np.float64]:
    """Of the object in the frame of the sensor as reported."""
    return se2.compose(se2.inverse(moment.sensor), moment.truth)


def test_the_readings_of_a_plain_trial_are_noisy_activations_of_where_the_skin_is(
    ring_model: ObservationModel,
) -> None:
    """With gains that last; what is drawn, and in which order."""
    model, rng = ring_model, np.random.default_rng(3)
    most = np.array([trials.PLACE_M, trials.PLACE_M, np.pi])
    truth = rng.uniform(-most, most)
    gain = np.maximum(1.0 + 0.17 * rng.standard_normal(len(model.layout)), 0.1)
    presses = trials.presses(model, TOUCHES, rng)
    found = moments(model)
    assert {m.touch for m in found} == set(range(TOUCHES))
    for moment in found:
        pose = true_pose(moment)
        h = model.activation(pose[None])[0]
        z = gain * h + 0.02 * rng.standard_normal(len(h))
        z = np.where(z < 0.1, 0.0, np.minimum(z, 1.0))
        assert np.allclose(moment.activation.z, z, atol=1e-6)
        assert moment.activation.live.all()
        assert moment.activation.floor == 0.1
        assert np.allclose(moment.truth, truth)
    for press, scans in zip(presses, by_touch(found), strict=True):
        assert any(np.allclose(true_pose(scan), press) for scan in scans)


def test_a_touch_is_approached_pressed_held_and_released_by_degrees(
    ring_model: ObservationModel,
) -> None:
    """A filter meets rising and falling presses, and silence on the way, as on a robot."""
    for scans in by_touch(moments(ring_model)):
        depth_m = -gap_m(ring_model, np.array([true_pose(m) for m in scans]))
        pressed = np.flatnonzero(depth_m > 1e-5)
        assert (np.diff(pressed) == 1).all()  # one contact
        deep = depth_m[pressed]
        held = np.flatnonzero(deep > deep.max() - 1e-5)
        assert len(held) == TrialConditions().scans
        assert (np.diff(deep[: held[0] + 1]) > 0.0).all()
        assert (np.diff(deep[held[-1] :]) < 0.0).all()
        assert held[0] >= 3
        assert len(deep) - 1 - held[-1] >= 2
        assert pressed[0] >= 6
        assert 20 <= len(scans) <= 30
        t = np.diff([m.activation.t for m in scans])
        assert (t > 0.0).all()
        assert np.allclose(t[pressed], trials.SCAN_S)


def test_between_touches_the_skin_is_clear_of_every_object(ring_model: ObservationModel) -> None:
    for given in ({}, {"both": 3}):
        for scans in by_touch(moments(ring_model, **given)):
            for moment in scans[: trials.FREE]:
                for truth in (moment.truth, moment.twin):
                    if truth is not None:
                        seen = se2.compose(se2.inverse(moment.sensor), truth)
                        assert gap_m(ring_model, seen[None])[0] > 0.02  # as far as a grid reaches


def test_a_press_nudges_the_object_away_from_the_skin_and_it_stays_there(
    ring_model: ObservationModel,
) -> None:
    plain, given = moments(ring_model), moments(ring_model, nudged_m=0.002)
    before = given[0].truth
    assert np.array_equal(before, plain[0].truth)
    for scans in by_touch(given):
        free = scans[: trials.FREE + len(trials.APPROACH_M)]
        assert all(np.allclose(m.truth, before) for m in free)
        after = scans[-1].truth
        moved = after[:2] - before[:2]
        assert 0.0004 < np.hypot(*moved) < 0.006  # of the origin, as the object turns as well
        inwards = scans[0].truth[:2] - scans[-1].sensor[:2]
        assert moved @ inwards > -0.002 * np.hypot(*inwards)
        steps = np.array([m.truth for m in scans])[len(free) - 1 :]
        held = np.flatnonzero((np.abs(np.diff(steps, axis=0)) > 1e-12).any(axis=1))
        assert len(held) == len(trials.PRESSING) + 1  # it gives way as it is pressed
        before = after
    for a, b in zip(plain, given, strict=True):  # the touches are the same
        assert np.allclose(true_pose(a), true_pose(b), atol=1e-9)


def test_a_seed_replays_a_trial(ring_model: ObservationModel) -> None:
    given = {"dead_share": 0.2, "drift": 0.1, "sensor_sd_m": 0.002, "pushed_m": 0.01}
    for a, b in zip(moments(ring_model, **given), moments(ring_model, **given), strict=True):
        assert np.array_equal(a.activation.z, b.activation.z)
        assert np.array_equal(a.sensor, b.sensor)
    other = moments(ring_model, 4, **given)
    assert not np.array_equal(other[0].truth, moments(ring_model, **given)[0].truth)


def test_an_object_is_kidnapped_once_or_moves_along_a_line(ring_model: ObservationModel) -> None:
    def truths(**given: float) -> Poses:
        return np.array([scans[0].truth for scans in by_touch(moments(ring_model, **given))])

    found = truths(kidnapped_after=4)
    moved = [not np.array_equal(a, b) for a, b in pairwise(found)]
    assert moved == [False, False, False, True, False]
    assert (np.abs(found[4]) <= [trials.PLACE_M, trials.PLACE_M, np.pi]).all()
    step = np.diff(truths(pushed_m=0.01, pushed_rad=0.1), axis=0)
    assert np.allclose(step, step[0])
    assert np.hypot(*step[0, :2]) == pytest.approx(0.01)
    assert abs(step[0, 2]) == pytest.approx(0.1)


@pytest.mark.parametrize(
    "given",
    [
        {"kidnapped_after": 2},
        {"pushed_m": 0.02},
        {"dead_share": 0.3},
        {"stuck": 3},
        {"drift": 0.1},
        {"sensor_sd_m": 0.005},
        {"nudged_m": 0.002},
    ],
)
def test_conditions_leave_the_touches_of_a_seed_as_they_are(
    ring_model: ObservationModel, given: dict[str, float]
) -> None:
    """All scans come from the truth that they name."""
    for a, b in zip(moments(ring_model), moments(ring_model, **given), strict=True):
        if "sensor_sd_m" not in given:
            assert np.allclose(true_pose(a), true_pose(b))
        if given.keys() <= {"kidnapped_after", "pushed_m", "nudged_m", "sensor_sd_m"}:
            assert np.allclose(a.activation.z, b.activation.z)


def test_dead_taxels_are_known_and_read_zero(ring_model: ObservationModel) -> None:
    taxels = len(ring_model.layout)
    share = moments(ring_model, dead_share=0.25)
    assert all((m.activation.live == share[0].activation.live).all() for m in share)
    assert (~share[0].activation.live).sum() == taxels // 4
    assert all((m.activation.z[~m.activation.live] == 0.0).all() for m in share)
    modules = moments(ring_model, dead_modules=2)[0].activation.live
    dead = {int(i) // 10 for i in np.flatnonzero(~modules)}
    assert len(dead) == 2
    assert all(not modules[10 * module : 10 * module + 10].any() for module in dead)


def test_stuck_taxels_count_as_live(ring_model: ObservationModel) -> None:
    for at in (0.0, 1.0):
        found = moments(ring_model, stuck=3, stuck_at=at)
        z = np.array([m.activation.z for m in found])
        assert (z == at).all(axis=0).sum() >= 3
        assert all(m.activation.live.all() for m in found)
    free = moments(ring_model, stuck=3)[0].activation.z
    assert (free == 1.0).sum() == 3


def test_drift_grows_to_its_given_size(ring_model: ObservationModel) -> None:
    still = np.zeros(len(ring_model.layout))
    rng = np.random.default_rng(0)
    skin = TrialSkin(TrialConditions(sigma=0.0, drift=0.1), ring_model.layout, still + 1.0, rng)
    early, late = (skin.read(still + 0.5, 0.0, share, rng).z for share in (0.1, 1.0))
    assert np.allclose(late - 0.5, 10.0 * (early - 0.5))
    assert 0.05 < np.abs(late - 0.5).max() <= 0.1


def test_deep_touches_saturate(ring_model: ObservationModel) -> None:
    rng = np.random.default_rng(0)
    poses = trials.presses(ring_model, 200, rng, depth=2.0)
    deep = -gap_m(ring_model, poses)
    assert ring_model.depth_max_m < deep.max() <= 2.0 * ring_model.depth_max_m + 1e-3
    assert ring_model.activation(poses).max() == 1.0


def test_the_error_of_the_sensor_pose_lasts_a_touch(ring_model: ObservationModel) -> None:
    plain = moments(ring_model)
    wrong = moments(ring_model, sensor_sd_m=0.005, sensor_sd_rad=0.02)
    error = np.array([b.sensor - a.sensor for a, b in zip(plain, wrong, strict=True)])
    touch = np.array([m.touch for m in plain])
    for i in range(TOUCHES):
        assert np.allclose(error[touch == i], error[touch == i][0])
    assert len(np.unique(error.round(9), axis=0)) == TOUCHES
    assert all(np.array_equal(a.truth, b.truth) for a, b in zip(plain, wrong, strict=True))


def test_one_sided_touches_stay_on_one_side(ring_model: ObservationModel) -> None:
    found = moments(ring_model, one_side=True)
    ax, ay = contacts.axis_in_object(
        np.array([true_pose(m) for m in found if m.activation.z.any()])
    )
    centre = ring_model.scene.centre
    angle = np.arctan2(ay - centre[1], ax - centre[0])
    assert np.abs(se2.wrap(angle - angle[0])).max() <= 2.0 * SIDE_RAD


def test_another_object_stands_beside_and_is_pressed_as_often_as_asked(
    ring_model: ObservationModel,
) -> None:
    for seed in range(5):
        twin = Twin(ring_model, np.random.default_rng(seed))
        outline = se2.apply(twin.pose, ring_model.scene.outline)
        gap = ring_model.scene.clearance(*outline.T)[0].min()
        assert TWIN_GAP_M - 0.004 < gap <= TWIN_GAP_M
    plain = TrialConditions(sigma=0.0, gain_cv=0.0)
    found = list(Trial(ring_model, 3, TOUCHES, replace(plain, both=2)))
    pressed = set()
    for moment in found:
        alone = ring_model.activation(true_pose(moment)[None])[0]
        assert moment.twin is not None
        seen = se2.compose(se2.inverse(moment.sensor), moment.twin)
        twin = ring_model.activation(seen[None])[0]
        assert np.allclose(moment.activation.z, np.maximum(alone, twin), atol=1e-9)
        if (moment.activation.z > alone + 0.05).any():
            pressed.add(moment.touch)
    assert len(pressed) == 2


def test_a_press_is_held_for_as_many_scans_as_asked(ring_model: ObservationModel) -> None:
    usual = len(moments(ring_model)) // TOUCHES - TrialConditions().scans
    for scans in (1, 20):
        found = moments(ring_model, scans=scans, slip_m=0.001)
        assert len(found) == TOUCHES * (usual + scans)
        first = trials.FREE + len(trials.APPROACH_M) + len(trials.PRESSING)
        held = np.array([true_pose(m) for m in found if m.touch == 0])[first : first + scans]
        assert (np.ptp(held[:, :2], axis=0) < 0.01).all()
        assert scans == 1 or (np.ptp(held[:, :2], axis=0) > 1e-4).all()


def test_touches_that_do_not_exist_are_refused_in_one_line(
    ring_model: ObservationModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "BATCHES_MAX", 2)
    with pytest.raises(SetupError, match="hardly exist"):
        trials.presses(
            ring_model, 1, np.random.default_rng(0), accepts=lambda poses: poses[:, 0] > 9.0
        )


def skin(config: MeshConfig, seed: int = 0) -> SoftSkin:
    return SoftSkin(config, LAYOUT, np.ones(TAXELS), np.random.default_rng(seed))


def test_the_cover_sags_less_with_distance() -> None:
    pressed = np.where(np.arange(TAXELS) == 24, 0.8, 0.0)
    z, _ = skin(replace(STILL, sag_m=(0.006, 0.006))).read(pressed, 0.0)
    apart = np.linalg.norm(LAYOUT.position_m - LAYOUT.position_m[24], axis=1)
    np.testing.assert_allclose(z, 0.8 * np.exp(-apart / 0.006), atol=1e-6)


class GivenDepths:
    """Depths, given for each step, in place of a solid's."""

    def __init__(self, depth_m: Floats) -> None:
        self.depth_m = depth_m

    def indentation(self, seen: Poses, _sag_m: Floats) -> Floats:
        return np.asarray(self.depth_m[int(seen[0])])


def test_presses_are_read_as_the_harness_reads_them() -> None:
    """Whatever is drawn is given, and sag is off, which is a solid's there: then response, loop,
    residues and cross-talk are the same, press after press, scan by scan."""
    config = replace(
        TYPICAL,
        sag_m=LITTLE,
        onset=(1.5, 1.5),
        hysteresis=(0.03, 0.03),
        residue=(0.02, 0.02),
        residue_slow=(0.05, 0.05),
        cross_talk=(0.03, 0.03),
        noise_counts=LITTLE,
    )
    rng = np.random.default_rng(0)
    h = np.repeat(rng.uniform(0.0, 1.0, (40, TAXELS)), 5, axis=0)
    h[np.repeat(rng.random((40, TAXELS)) < 0.8, 5, axis=0)] = 0.0
    h[np.repeat(np.arange(40) % 4 == 3, 5)] = 0.0  # nothing is touched in every fourth
    ours, depth_max_m = skin(config), 0.005
    theirs = MeshPhysics(
        config,
        GivenDepths(depth_max_m * h),
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
        np.array([m.activation.z for m in Trial(ring_model, 3, 2, TrialConditions(skin=name))])
        for _ in range(2)
    )
    plain = np.array([m.activation.z for m in Trial(ring_model, 3, 2)])
    assert found.shape == plain.shape
    assert not np.array_equal(found, plain)
    np.testing.assert_array_equal(found, again)


def test_a_guided_approach_presses_where_it_meets_the_object_and_else_meets_nothing(
    ring_model: ObservationModel,
) -> None:
    truth = moments(ring_model)[0].truth
    away, until = truth - np.array([0.3, 0.0, 0.0]), truth + np.array([0.3, 0.0, 0.0])

    def through(beside_m: float) -> list[list[TrialScan]]:
        off = np.array([0.0, beside_m, 0.0])
        told = Approach(0, away + off, truth, until + off, 0.0, 0.002, 0.0, 0.0, 0.0)
        trial = Trial(ring_model, 3, 2, TrialConditions(sigma=1e-9), lambda k: told if k else None)
        return by_touch(list(trial))

    first, pressed = through(0.0)
    _, missed = through(0.4)
    assert [scan.sensor.tolist() for scan in first] == [
        scan.sensor.tolist() for scan in by_touch(moments(ring_model, sigma=1e-9))[0]
    ]
    gap = gap_m(ring_model, np.array([true_pose(scan) for scan in pressed]))
    assert gap.min() == pytest.approx(-FELT_M - 0.002, abs=1e-3)
    assert gap[-1] > 0.0  # it is let go
    assert not any(scan.activation.z.any() for scan in missed)
