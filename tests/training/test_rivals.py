"""Rivals from sbi: proposals like any other, repeatable, quiet, better than an uninformed one."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model.observation import Noise, ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.proposals.analytic import Projection
from taxeld_training.limits import quality
from taxeld_training.limits.rivals import train_rival

from .conftest import RING

pytest.importorskip("sbi")

SKIN = layouts.load(RING)
LIVE = np.ones(len(SKIN), dtype=bool)
EPOCHS = {"npe": 5, "npse": 30, "fmpe": 20}


@pytest.fixture(scope="module")
def model(ring_model: ObservationModel) -> ObservationModel:
    return ring_model


@pytest.fixture(scope="module")
def reference(model: ObservationModel) -> quality.Reference:
    return quality.reference(model, Noise(), 10, np.random.default_rng(5), bank=50_000)


def train(kind: str, model: ObservationModel, contacts: int, epochs: int) -> Proposal:
    return train_rival(kind, model, Noise(), contacts=contacts, seed=3, max_epochs=epochs)


@pytest.mark.parametrize("kind", EPOCHS)
def test_a_seed_determines_training_and_samples(
    kind: str,
    model: ObservationModel,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Two trainings give the same poses, write nothing and leave torch's generator alone."""
    monkeypatch.chdir(tmp_path)
    z = np.zeros(len(SKIN))
    z[5], live = 0.8, LIVE.copy()
    live[9] = False
    state = torch.get_rng_state()
    one, other = (train(kind, model, 300, 2) for _ in range(2))
    poses = one.propose(z, live, 40, np.random.default_rng(1))
    assert one.name == kind
    assert poses.shape == (40, 3)
    assert np.isfinite(poses).all()
    assert np.array_equal(poses, other.propose(z, live, 40, np.random.default_rng(1)))
    assert not np.array_equal(poses, one.propose(z, live, 40, np.random.default_rng(2)))
    z[9] = 1.0
    assert np.array_equal(poses, one.propose(z, live, 40, np.random.default_rng(1)))
    assert torch.equal(state, torch.get_rng_state())
    assert not list(tmp_path.iterdir())
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("kind", EPOCHS)
def test_a_rival_trained_a_little_beats_the_uninformed_proposal(
    kind: str, model: ObservationModel, reference: quality.Reference
) -> None:
    rival = train(kind, model, 3000, EPOCHS[kind])
    uninformed, learned = (
        quality.distances(proposal, reference, np.random.default_rng(0)).mean()
        for proposal in (Projection(model), rival)
    )
    assert learned < 0.5 * uninformed


@pytest.mark.parametrize("kind", EPOCHS)
def test_a_turned_touch_gives_turned_poses(kind: str, model: ObservationModel) -> None:
    rival = train(kind, model, 300, 1)
    z = np.zeros(len(SKIN))
    z[5] = 0.8
    straight = rival.propose(z, LIVE, 20, np.random.default_rng(1))
    turned = rival.propose(z[SKIN.turns[4]], LIVE, 20, np.random.default_rng(1))
    angle = np.exp(-2j * np.pi * 4 / len(SKIN.turns))
    assert np.allclose(turned[:, :2] @ [1, 1j], straight[:, :2] @ [1, 1j] * angle, atol=1e-6)
    assert np.allclose(np.exp(1j * turned[:, 2]), np.exp(1j * straight[:, 2]) * angle, atol=1e-5)


def test_an_unknown_rival_is_named(model: ObservationModel) -> None:
    with pytest.raises(SetupError, match="'abc' is no rival; use one of npe, npse, fmpe"):
        train_rival("abc", model, Noise())


def test_without_sbi_the_cure_is_named(
    model: ObservationModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "sbi", None)
    with pytest.raises(SetupError, match=r"not installed; pip install 'taxeld\[rivals\]'"):
        train_rival("npe", model, Noise(), contacts=300)
