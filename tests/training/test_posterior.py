"""The reference: contacts, batches, and the exact posterior by a bank and by contacts around it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from taxeld.arrays import Floats
from taxeld.model import se2
from taxeld.model.noise import FLOOR, Noise
from taxeld_training.limits import quality
from taxeld_training.limits.dense import Dense
from taxeld_training.limits.posterior import ExactPosterior, energy_distance
from taxeld_training.models.dataset import (
    FLOOR_MAX,
    MIN_ACTIVATION,
    Batches,
    read,
    simulate,
)
from taxeld_training.models.frames import PoseFrame

from .rig import HALF, HALF_SKIN, MODEL, SKIN, TOUCHES

NOISE = Noise()
DRAWS = 1000


def drawn(noise: Noise, n: int) -> list[Floats]:
    """z, live and pose of `n` readings that training meets."""
    coordinates = PoseFrame().encode(TOUCHES.pose)
    batches = Batches(TOUCHES, coordinates, MODEL.leak, noise, 1, torch.device("cpu"))
    return [part.double().numpy() for part in batches.draw(n)]


def test_training_meets_readings_of_poses_that_press_a_taxel() -> None:
    """Up to what presses beside a taxel may leave in it."""
    assert (TOUCHES.activation.max(axis=1) > MIN_ACTIVATION).all()
    z, live, pose = drawn(Noise(sigma=0.0, gain_cv=0.0), 500)
    expected = MODEL.activation(pose) * live
    felt = z > 0.0
    assert (np.abs(z - expected) < 1e-3 + 6.0 * MODEL.leak.drawn(expected))[felt].all()
    assert (expected < 0.4)[~felt].all()
    assert 0.01 < (live == 0).mean() < 0.2


def test_training_meets_floors_of_any_height_and_presses_that_are_read_beside_them() -> None:
    """What is learned holds for all skins of the trials, and for one that sags and couples. But
    nothing is met that presses beside a taxel may explain."""
    z, _, pose = drawn(NOISE, 3000)
    least = np.where(z > 0.0, z, np.inf).min(axis=1)
    assert (least >= FLOOR).all()
    assert 0.3 < np.mean(least > 0.5 * FLOOR_MAX) < 1.0  # of an unthresholded skin hardly any
    assert (z.max(axis=1) > 0.0).mean() > 0.99
    # more than noise, which is never felt on its own
    assert 0.005 < np.mean((z > 0.0) & (MODEL.activation(pose) == 0.0)) < 0.1
    for each in (z, read(MODEL, NOISE, 500, np.random.default_rng(0)).z):
        assert (each[each > 0.0] >= MODEL.leak.of(each)[each > 0.0]).all()


def test_readings_are_as_a_filter_sees_them() -> None:
    seen = read(MODEL, NOISE, 500, np.random.default_rng(0), dead=0.3)
    assert len(seen.z) == len(list(seen)) == 500
    assert ((seen.z == 0.0) | (seen.z >= seen.floor)).all()
    assert (seen.floor >= FLOOR).all()
    assert (seen.floor >= seen.residue).all()  # what presses beside a taxel leave is under it
    assert np.ptp(seen.floor.min(axis=1)) > 0.05  # skins differ
    assert seen.z.any(axis=1).all()  # each is felt
    assert (seen.z[~seen.live] == 0.0).all()
    assert np.mean(~seen.live) == pytest.approx(0.3, abs=0.02)


def test_the_exact_posterior_is_that_of_the_daemons_likelihood() -> None:
    """Against importance weights over the same bank with every turn tried, and no shortcut."""
    rng = np.random.default_rng(0)
    bank = simulate(MODEL, 4000, rng)
    posterior = ExactPosterior(bank, SKIN, NOISE)
    back = np.zeros((len(SKIN.turns), 3))
    back[:, 2] = -2.0 * np.pi * np.arange(len(SKIN.turns)) / len(SKIN.turns)
    poses = np.concatenate([se2.compose(turn, bank.pose) for turn in back])
    told = []
    for seen in read(MODEL, NOISE, 6, rng):
        log_w = np.concatenate(
            [
                NOISE.log_density(
                    seen.z, bank.activation[:, turn].astype(float), seen.floor, seen.residue
                ).sum(axis=1)
                for turn in SKIN.turns
            ]
        )
        w = np.exp(log_w - log_w.max())
        pick = rng.choice(len(w), 2000, p=w / w.sum())
        ess = w.sum() ** 2 / (w**2).sum()
        # floors and residues count: without them it is another posterior
        variants = seen, replace(seen, floor=FLOOR), replace(seen, residue=0.0)
        found = [posterior.sample(one, 2000, rng) for one in variants]
        assert energy_distance(found[0].pose, poses[pick], 0.05) < 0.01
        told.append(np.isclose([draws.ess for draws in found], ess, rtol=0.05))
    assert np.all(told, axis=0).tolist() == [True, False, False]


@pytest.mark.parametrize("shift", [0.0, 1.5])
def test_the_distance_of_two_normal_distributions_is_that_of_the_closed_form(shift: float) -> None:
    """E|N(m, v)| = √(2v/π) exp(−m²/2v) + m erf(m/√(2v)) in one dimension, here of v = 2. Of few
    samples it is right on average, so that of one distribution it is now and then below 0."""
    rng = np.random.default_rng(0)
    samples = np.zeros((500, 2, 30, 3))
    samples[..., 0] = rng.standard_normal(samples.shape[:-1])
    samples[:, 1, :, 0] += shift
    found = np.array([energy_distance(a, b, 1.0) for a, b in samples])
    apart = [
        2.0 / np.sqrt(np.pi) * np.exp(-(m**2) / 4.0) + m * math.erf(m / 2.0) for m in (shift, 0.0)
    ]
    expected = 2.0 * (apart[0] - apart[1])
    assert abs(found.mean() - expected) < 3.0 * found.std() / np.sqrt(len(found))
    assert (found < 0.0).any() == (shift == 0.0)


@pytest.mark.check
def test_contacts_made_around_a_reading_have_the_posterior_of_a_large_bank() -> None:
    """A hundredth of the contacts is enough to begin with."""
    rng = np.random.default_rng(1)
    thin, full = (
        ExactPosterior(simulate(MODEL, contacts, rng), SKIN, NOISE) for contacts in (2_000, 200_000)
    )
    dense = Dense(MODEL, NOISE, rng)
    length_m = MODEL.scene.size
    told = 0
    for one in read(MODEL, NOISE, 6, np.random.default_rng(4)):
        made = dense.sample(one, DRAWS, rng, thin)
        assert made.ess > max(quality.LIMIT_ESS, thin.sample(one, 1, rng).ess)
        exact = full.sample(one, 2 * DRAWS, rng)
        half, other = exact.pose[:DRAWS], exact.pose[DRAWS:]
        assert energy_distance(made.pose, half, length_m) < 0.05
        if exact.ess >= 2 * DRAWS:
            told += 1
            floor = energy_distance(half, other, length_m)
            assert energy_distance(made.pose, half, length_m) < floor + 0.01
    assert told >= 2


@pytest.mark.check
def test_no_reading_is_left_out_where_the_bank_alone_leaves_out_most() -> None:
    rng = np.random.default_rng(2)
    to = quality.reference(HALF, NOISE, 6, rng, bank=5_000)
    assert len(to.z) == 6
    assert min(to.ess) >= quality.LIMIT_ESS
    bank = ExactPosterior(simulate(HALF, 5_000, rng), HALF_SKIN, NOISE)
    alone = [bank.sample(one, 1, rng).ess for one in read(HALF, NOISE, 12, rng)]
    assert np.mean(np.array(alone) < quality.LIMIT_ESS) > 0.5
