"""A small box on small skins, and the readings of it."""

from pathlib import Path

import numpy as np
import pytest

from taxeld.model.observation import ObservationModel
from taxeld_training.models.dataset import SimulatedTouches, simulate

from . import rig


@pytest.fixture(scope="session")
def ring_model() -> ObservationModel:
    return rig.model_of(rig.ring())


@pytest.fixture(scope="session")
def half_model() -> ObservationModel:
    return rig.model_of(rig.half_skin())


@pytest.fixture(scope="session")
def touches(ring_model: ObservationModel) -> SimulatedTouches:
    return simulate(ring_model, 20_000, np.random.default_rng(0))


@pytest.fixture(scope="session")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The box as a mesh file."""
    path = tmp_path_factory.mktemp("mesh") / "block.stl"
    rig.box().export(path)
    return path
