"""What a taxel reads of presses beside it is no evidence of a press."""

import numpy as np

from taxeld.config.tables import FilterConfig
from taxeld.estimator.intake import Intake
from taxeld.estimator.rule import EstimatorCounters
from taxeld.layout.layout import Layout
from taxeld.model.leak import CROSS_TALK, REACH_M, Leak
from taxeld.model.noise import Noise
from taxeld.model.observation import Activation, ObservationModel


def one_pressed(taxels: int) -> np.ndarray:
    z = np.zeros(taxels)
    z[0] = 0.8
    return z


def test_a_press_leaks_into_its_module_and_beside_it(skin: Layout) -> None:
    leak = Leak(skin).of(one_pressed(len(skin)))
    apart = np.linalg.norm(skin.position_m - skin.position_m[0], axis=1)
    module = skin.uid >> 4
    far_away = (module != module[0]) & (apart > 0.03)
    coupled = (module == module[0]) & (apart > 0.03)
    assert leak[0] == 0.0
    assert np.allclose(leak[coupled], CROSS_TALK * 0.8)
    assert (leak[far_away] == 0.0).all()
    height = abs(skin.position_m[:, 2] - skin.position_m[0, 2])
    above = (apart > 0.0) & np.isclose(apart, height)
    sag = np.exp(-apart[above] / REACH_M) * 0.8
    assert np.allclose(
        leak[above],
        np.where(sag < 0.008, 0.0, sag) + CROSS_TALK * 0.8 * (module == module[0])[above],
    )
    assert (leak[above & (apart < 0.016)] > 0.05).all()


def test_a_reading_that_may_be_leaked_is_none_and_raises_what_is_felt(
    box_model: ObservationModel,
) -> None:
    taxels = len(box_model.layout)
    intake = Intake(box_model, EstimatorCounters())
    z = one_pressed(taxels)
    beside = int(np.argmax(box_model.leak.of(z)))
    z[beside] = 0.03
    live = np.ones(taxels, dtype=np.bool_)
    seen = intake.observation(Activation(0.0, z, live), np.zeros(3))
    assert seen is not None
    assert seen.z[beside] == 0.0
    assert seen.z[0] == 0.8
    assert np.broadcast_to(seen.floor, taxels)[beside] >= box_model.leak.of(z)[beside] > 0.03


def test_training_takes_readings_for_what_the_estimator_takes_them(
    box_model: ObservationModel,
) -> None:
    """Many at once, as one by one: the samplers learn what the filter asks them about."""
    rng = np.random.default_rng(0)
    shape = 200, len(box_model.layout)
    z = np.where(rng.random(shape) < 0.15, rng.uniform(0.05, 1.0, shape), 0.0)
    floor, residue = 0.05 * rng.random(shape), 0.02 * rng.random(shape)
    together = box_model.leak.without(z, floor, residue)
    live = np.ones(shape[1], dtype=np.bool_)
    for one, alone in zip(
        zip(z, floor, residue, strict=True), zip(*together, strict=True), strict=True
    ):
        intake = Intake(box_model, EstimatorCounters())
        seen = intake.observation(Activation(0.0, one[0], live, *one[1:]), np.zeros(3))
        assert seen is not None
        for expected, found in zip((seen.z, seen.floor, seen.residue), alone, strict=True):
            assert np.allclose(expected, found, rtol=0.0, atol=1e-12)
    assert (together[0] != z).any()


def test_a_reading_that_leaks_may_have_costs_a_pose_little() -> None:
    noise = Noise(FilterConfig().noise_sigma, FilterConfig().gain_cv)
    plain = noise.log_density(np.array(0.2), np.array(0.0))
    leaked = noise.log_density(np.array(0.2), np.array(0.0), residue=0.12)
    assert leaked > plain + 3.0
