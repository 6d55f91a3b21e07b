"""Which scans count, which taxels of them, and what a taxel reads of presses beside it."""

import numpy as np
import pytest

from taxeld.estimator.news import EstimatorCounters, Intake, News, Stuck
from taxeld.layout.layout import Layout
from taxeld.model.leak import CROSS_TALK, REACH_M, Leak
from taxeld.model.observation import Activation, Observation, ObservationModel

LIVE = np.ones(4, dtype=bool)


def feel(strongest: float, x: float = 0.0, place_sd_m: float = 0.0) -> Observation:
    z = np.array([strongest, 0.0, 0.0, 0.0])
    return Observation(np.array([x, 0.0, 0.0]), z, LIVE, place_sd_m=place_sd_m)


STAYS = [0.0] * 7
# the strongest activation of each scan, where it is felt [m]; of those that count, the activation
COUNTED = {
    "a press, once it stops deepening": (
        [0.0, 0.2, 0.4, 0.6, 0.61, 0.6, 0.6], STAYS, {0: 0.0, 4: 0.61}
    ),
    "a tap that ends while deepening, by its strongest": (
        [0.0, 0.2, 0.5, 0.0, 0.0], STAYS, {0: 0.0, 3: 0.5}
    ),
    "a press that eases, as it is held": ([0.3, 0.6, 0.5, 0.5], STAYS, {2: 0.5}),
    "a slide, every few millimetres": (
        [0.5] * 7, [0.0, 0.0, 0.002, 0.004, 0.006, 0.008, 0.012], {1: 0.5, 4: 0.5, 6: 0.5}
    ),
    "a taxel that changes much": ([0.3, 0.3, 0.6, 0.9, 0.9], STAYS, {1: 0.3, 4: 0.9}),
    "no release": ([0.9, 0.9, 0.5, 0.3, 0.1], STAYS, {1: 0.9}),
    "silence, as the sensor moves": (
        [0.0] * 6, [0.0, 0.0, 0.003, 0.006, 0.006, 0.02], {0: 0.0, 3: 0.0, 5: 0.0}
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", COUNTED)
def test_what_counts_at_20_hz(what: str) -> None:
    news, (readings, x, expected) = News(0.04), COUNTED[what]
    felt = [news.on_scan(0.05 * k, feel(z, x[k])) for k, z in enumerate(readings)]
    assert {k: told.z.max() for k, told in enumerate(felt) if told is not None} == expected


@pytest.mark.parametrize(("held_sd_m", "counted"), [(0.001, 0.6), (0.002, 0.6), (0.003, 0.61)])
def test_of_a_press_the_scan_that_is_placed_better_counts(held_sd_m: float, counted: float) -> None:
    news = News(0.04)
    assert news.on_scan(0.0, feel(0.2)) is None
    assert news.on_scan(0.05, feel(0.61, place_sd_m=0.002)) is None
    used = news.on_scan(0.1, feel(0.6, place_sd_m=held_sd_m))
    assert used is not None
    assert used.z.max() == counted


def test_a_flicker_does_not_begin_a_contact() -> None:
    news = News(0.04)
    for k, strongest in enumerate([0.5, 0.5, 0.0, 0.5, 0.5]):
        news.on_scan(0.05 * k, feel(strongest))
    assert news.contacts == 1
    news.on_scan(1.0, feel(0.0))
    assert not news.contact
    news.on_scan(1.1, feel(0.5))
    assert news.contacts == 2


VARIES = np.clip(0.5 + 0.02 * np.random.default_rng(0).standard_normal((200, 2)), 0.0, 1.0)


@pytest.mark.parametrize(
    ("readings", "moved_m", "stuck"),
    [
        pytest.param([[1.0, 0.0]] * 6, 0.03, [0, 0, 0, 0, 1, 1], id="the same on a long way"),
        pytest.param([[0.5]] * 6 + [[0.52]] * 2, 0.03, [0] * 4 + [1, 1, 0, 0], id="it changes"),
        pytest.param([[0.8, 0.4]] * 1000, 0.0, [0] * 1000, id="a touch is held"),
        pytest.param([[0.0, 0.0]] * 20, 0.1, [0] * 20, id="silence"),
        pytest.param(VARIES.tolist(), 0.005, [0] * 200, id="a press varies on its way"),
        pytest.param([[0.5]] * 3 + [[]] + [[0.5]] * 6, 0.03, [0] * 8 + [1, 1], id="a release"),
    ],
)
def test_a_taxel_that_reads_the_same_wherever_the_skin_goes_is_stuck(
    readings: list[list[float]], moved_m: float, stuck: list[int]
) -> None:
    subject, found = Stuck(len(readings[0])), []
    for z in readings:
        if z:
            found.append(int(subject.on_scan(np.array(z), moved_m).sum()))
        else:
            subject.released()
            found.append(0)
    assert found == stuck


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
