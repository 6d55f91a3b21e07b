"""What a taxel reads of presses beside it is no evidence of a press."""

import numpy as np

from taxeld.estimator.news import EstimatorCounters, Intake
from taxeld.layout.layout import Layout
from taxeld.model.leak import CROSS_TALK, REACH_M, Leak
from taxeld.model.observation import Activation, ObservationModel


def one_pressed(taxels: int) -> np.ndarray:
    z = np.zeros(taxels)
    z[0] = 0.8
    return z


def test_a_press_leaks_into_its_module_and_beside_it(skin: Layout) -> None:
    leak = Leak(skin).of(one_pressed(len(skin)))
    many = np.stack([one_pressed(len(skin)), np.zeros(len(skin))])
    assert np.allclose(Leak(skin).of(many), [leak, 0.0 * leak])
    apart = np.linalg.norm(skin.position_m - skin.position_m[0], axis=1)
    module = skin.uid >> 4
    far_away = (module != module[0]) & (apart > 0.03)
    coupled = (module == module[0]) & (apart > 0.03)
    assert leak[0] == 0.0
    assert np.allclose(leak[coupled], CROSS_TALK * 0.8)
    assert (leak[far_away] == 0.0).all()
    above = (apart > 0.0) & np.isclose(apart, abs(skin.position_m[:, 2] - skin.position_m[0, 2]))
    sag = np.exp(-apart[above] / REACH_M) * 0.8
    talk = CROSS_TALK * 0.8 * (module == module[0])[above]
    assert np.allclose(leak[above], np.where(sag < 0.008, 0.0, sag) + talk)
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
