"""Contacts made around a reading: the same posterior, and where a bank has none."""

import numpy as np
import pytest

from taxeld.model.observation import Noise, ObservationModel
from taxeld_training.limits import quality
from taxeld_training.limits.dense import Dense
from taxeld_training.limits.posterior import ExactPosterior, energy_distance
from taxeld_training.models.dataset import Readings, read, simulate

NOISE = Noise()
DRAWS = 1000


@pytest.fixture(scope="module")
def seen(ring_model: ObservationModel) -> Readings:
    return read(ring_model, NOISE, 6, np.random.default_rng(4))


def test_contacts_made_around_a_reading_have_the_banks_posterior(
    ring_model: ObservationModel, seen: Readings
) -> None:
    rng = np.random.default_rng(0)
    model = ring_model
    bank = ExactPosterior(simulate(model, 200_000, rng), model.layout, NOISE)
    dense = Dense(model, NOISE, rng)
    told = 0
    for one in seen:
        exact = bank.sample(one, 2 * DRAWS, rng)
        if exact.ess < 2 * DRAWS:
            continue
        told += 1
        made = dense.sample(one, DRAWS, rng, bank, bank.weighed(one))
        half, other = exact.pose[:DRAWS], exact.pose[DRAWS:]
        floor = energy_distance(half, other, model.scene.size)
        assert energy_distance(made.pose, half, model.scene.size) < floor + 0.01
    assert told >= 2


def test_a_bank_that_is_too_thin_is_enough_to_begin_with(
    ring_model: ObservationModel, seen: Readings
) -> None:
    """A hundredth of the contacts leads to the same posterior, by many effective contacts."""
    rng = np.random.default_rng(1)
    model = ring_model
    thin = ExactPosterior(simulate(model, 2_000, rng), model.layout, NOISE)
    full = ExactPosterior(simulate(model, 200_000, rng), model.layout, NOISE)
    dense = Dense(model, NOISE, rng)
    for one in seen:
        made = dense.sample(one, DRAWS, rng, thin, thin.weighed(one))
        assert made.ess > quality.LIMIT_ESS
        assert made.ess > thin.sample(one, 1, rng).ess
        exact = full.sample(one, DRAWS, rng).pose
        assert energy_distance(made.pose, exact, model.scene.size) < 0.05


def test_no_reading_is_left_out_where_the_bank_alone_leaves_out_most(
    half_model: ObservationModel,
) -> None:
    rng = np.random.default_rng(2)
    to = quality.reference(half_model, NOISE, 12, rng, bank=5_000)
    assert to.left_out == 0
    assert min(to.ess) >= quality.LIMIT_ESS
    bank = ExactPosterior(simulate(half_model, 5_000, rng), half_model.layout, NOISE)
    alone = [bank.sample(one, 1, rng).ess for one in read(half_model, NOISE, 12, rng)]
    assert np.mean(np.array(alone) < quality.LIMIT_ESS) > 0.5
