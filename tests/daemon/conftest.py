"""The skin, objects and sockets of the daemon's tests."""

from collections.abc import Iterator

import pytest

from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.proposals import bundle
from taxeld.proposals.bundle import Bundle

from ..rig import scenes
from ..rig.scenes import DEPTH_MAX_M, disc, scene_of
from ..rig.skins import SKIN
from ..rig.sockets import Sockets


@pytest.fixture(scope="session")
def skin() -> Layout:
    return layouts.load("cylinder:rows=2,columns=16,radius_m=0.04,pitch_m=0.015")


@pytest.fixture(scope="session")
def box() -> Bundle:
    """The shipped box, for the skin of most tests."""
    return bundle.load("box", SKIN, DEPTH_MAX_M)


@pytest.fixture(scope="session")
def disc_model(skin: Layout) -> ObservationModel:
    return ObservationModel(scene_of(disc(0.05), skin, symmetry=0), skin, DEPTH_MAX_M)


@pytest.fixture(scope="session")
def box_model(skin: Layout) -> ObservationModel:
    return ObservationModel(scene_of(scenes.box(0.03, 0.06), skin, symmetry=2), skin, DEPTH_MAX_M)


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    with Sockets() as opened:
        yield opened
