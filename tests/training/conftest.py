"""A small box on small skins, and the readings of it."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld_training.models.dataset import Touches, simulate
from taxeld_training.objects import scenes

RING = "cylinder:rows=2,columns=16,radius_m=0.04,pitch_m=0.015"


def _box(skin: Layout) -> ObservationModel:
    mesh = trimesh.creation.box((0.06, 0.1, 0.1))
    mesh.apply_translation([0.0, 0.0, 0.05])
    return ObservationModel(scenes.build(mesh, skin, 0.04), skin, 0.005)


@pytest.fixture(scope="session")
def ring_model() -> ObservationModel:
    return _box(layouts.load(RING))


@pytest.fixture(scope="session")
def half_model() -> ObservationModel:
    """A skin over half of the link, its taxels in no order: no rotation leaves it as it is."""
    rng = np.random.default_rng(1)
    angle = np.sort(rng.uniform(-1.4, 1.4, 60))
    height = rng.choice([-0.008, 0.008], 60)
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(60)], axis=1)
    position = 0.04 * normal
    position[:, 2] = height
    uid = np.array([(i // 10 + 1) << 4 | (i % 10 + 1) for i in range(60)])
    return _box(Layout("half", uid, position, normal, 0.04))


@pytest.fixture(scope="session")
def touches(ring_model: ObservationModel) -> Touches:
    return simulate(ring_model, 20_000, np.random.default_rng(0))


@pytest.fixture(scope="session")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The box as a mesh file."""
    path = tmp_path_factory.mktemp("mesh") / "block.stl"
    trimesh.creation.box((0.06, 0.1, 0.1)).export(path)
    return path
