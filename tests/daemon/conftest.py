"""Scenes with closed forms, so that what the daemon computes can be checked by hand."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zmq

from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import Scene

DEPTH_MAX_M = 0.005
CELL = 0.002


def scene_of(distance, skin: Layout, symmetry: int, half_m: float = 0.2) -> Scene:  # type: ignore[no-untyped-def]
    """A scene of the same signed distance function at every height."""
    heights = np.unique(skin.position_m[:, 2])
    at = np.arange(-half_m, half_m + CELL / 2, CELL)
    x, y = np.meshgrid(at, at)
    grid = distance(x, y).astype(np.float32)
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = 0.05 * np.column_stack([np.cos(angle), np.sin(angle)])
    surface = np.concatenate([np.column_stack([ring, np.full(64, z)]) for z in heights])
    return Scene(
        slices=np.stack([grid] * len(heights)),
        silhouette=grid,
        heights=heights,
        origin=np.array([-half_m, -half_m]),
        cell=CELL,
        outline=ring,
        surface=surface,
        symmetry=symmetry,
        centre=np.zeros(2),
    )


def disc(radius_m: float):  # type: ignore[no-untyped-def]
    return lambda x, y: np.hypot(x, y) - radius_m


def box(a: float, b: float):  # type: ignore[no-untyped-def]
    """Signed distance of a rectangle of half sides a and b."""

    def distance(x, y):  # type: ignore[no-untyped-def]
        dx, dy = np.abs(x) - a, np.abs(y) - b
        outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0))
        return outside + np.minimum(np.maximum(dx, dy), 0)

    return distance


@pytest.fixture(scope="session")
def skin() -> Layout:
    return layouts.load("cylinder:rows=2,columns=16,radius_m=0.04,pitch_m=0.015")


@pytest.fixture(scope="session")
def disc_model(skin: Layout) -> ObservationModel:
    return ObservationModel(scene_of(disc(0.05), skin, symmetry=0), skin, DEPTH_MAX_M)


@pytest.fixture(scope="session")
def box_model(skin: Layout) -> ObservationModel:
    return ObservationModel(scene_of(box(0.03, 0.06), skin, symmetry=2), skin, DEPTH_MAX_M)


class Sockets(contextlib.ExitStack):
    """A context, and the sockets of a test, which are closed at its end."""

    def __init__(self) -> None:
        super().__init__()
        self.context: zmq.Context[Any] = self.enter_context(zmq.Context())

    def open(self, kind: int) -> zmq.Socket[Any]:
        return self.keep(self.context.socket(kind))

    def subscriber(self, endpoint: str, *topics: bytes) -> zmq.Socket[Any]:
        """It hears from then on; without topics, everything."""
        made = self.open(zmq.SUB)
        for topic in topics or (b"",):
            made.setsockopt(zmq.SUBSCRIBE, topic)
        made.connect(endpoint)
        return made

    def keep(self, socket: zmq.Socket[Any]) -> zmq.Socket[Any]:
        socket.setsockopt(zmq.LINGER, 0)
        return self.enter_context(socket)


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    with Sockets() as opened:
        yield opened
