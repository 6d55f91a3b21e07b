"""Proposals: where object poses that explain a touch come from. One interface for all of them."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taxeld import contacts, se2
from taxeld.observation import ObservationModel
from taxeld.se2 import Poses

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class Proposal(Protocol):
    """A sampler of p(pose | activations)."""

    name: str

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """z (M,), live (M,) → object poses (n, 3) in the sensor frame."""
        ...


class Projection:
    """The paper's uninformed baseline: contact poses that do not look at the activations."""

    name = "projection"

    def __init__(self, model: ObservationModel) -> None:
        self._model = model

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        model = self._model
        found = np.empty((0, 3))
        while len(found) < n:
            made = contacts.synthesise(
                model.scene, model.layout.radius_m, model.depth_max_m, 2 * n + 8, rng
            )
            found = np.concatenate([found, made.pose])
        return found[:n]


class Manifold:
    """Analytic: a point of the outline, turned to face the touched side, as deep as was felt.

    Exact for a smooth convex outline but for how much the taxels tell of its curvature; it weighs
    all points of the outline alike.
    """

    name = "manifold"

    def __init__(self, model: ObservationModel) -> None:
        self._model = model
        outline = model.scene.outline
        ahead, behind = np.roll(outline, -1, axis=0), np.roll(outline, 1, axis=0)
        tangent = ahead - behind
        area = np.sum(outline[:, 0] * ahead[:, 1] - ahead[:, 0] * outline[:, 1])
        outwards = -np.pi / 2 if area > 0 else np.pi / 2  # of the tangent's direction
        self._facing = np.arctan2(tangent[:, 1], tangent[:, 0]) + outwards

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        model = self._model
        scene, radius_m = model.scene, model.layout.radius_m
        felt = np.where(live, z, 0.0)
        at = felt @ model.layout.position_m[:, :2]
        touched = np.arctan2(at[1], at[0])
        depth_m = float(felt.max()) * model.depth_max_m
        i = rng.integers(len(scene.outline), size=n)
        theta = se2.wrap(touched + np.pi - self._facing[i])
        c, s = np.cos(theta), np.sin(theta)
        x, y = scene.outline[i].T
        gap = radius_m - depth_m
        px = gap * np.cos(touched) - (c * x - s * y)
        py = gap * np.sin(touched) - (s * x + c * y)
        poses, _ = contacts.project(
            scene, radius_m, np.column_stack([px, py, theta]), np.full(n, depth_m)
        )
        return poses


class Table:
    """The nearest of `size` stored contacts: what an engineer would try first.

    The contacts are simulated when it is made, so nothing is shipped. On a layout with rotation
    symmetry they are stored turned to their strongest taxel, and so is the question.
    """

    name = "table"

    def __init__(self, model: ObservationModel, size: int = 10_000, seed: int = 0) -> None:
        layout = model.layout
        rng = np.random.default_rng(seed)
        self._layout = layout
        h, poses = np.empty((0, len(layout))), np.empty((0, 3))
        while len(h) < size:
            made = contacts.synthesise(model.scene, layout.radius_m, model.depth_max_m, size, rng)
            felt = model.activation(made.pose)
            kept = felt.max(axis=1) > 0.0
            h, poses = np.concatenate([h, felt[kept]]), np.concatenate([poses, made.pose[kept]])
        h, poses = h[:size], poses[:size]
        turn = layout.sector[h.argmax(axis=1)]
        self._h = np.take_along_axis(h, layout.turns[turn], axis=1).astype(np.float32)
        self._square = np.square(self._h)
        self._pose = _turned(poses, -2.0 * np.pi * turn / len(layout.turns))

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        layout = self._layout
        turn = int(layout.sector[np.where(live, z, -1.0).argmax()])
        taxels = layout.turns[turn]
        mask = live[taxels].astype(np.float32)
        gap = self._square @ mask - 2.0 * (self._h @ (z[taxels].astype(np.float32) * mask))
        count = min(n, len(gap))
        nearest = np.argpartition(gap, count - 1)[:count]
        poses = self._pose[np.resize(nearest, n)]
        return _turned(poses, np.full(n, 2.0 * np.pi * turn / len(layout.turns)))


def _turned(poses: Poses, angle: Floats) -> Poses:
    """Poses (N, 3) turned about the sensor's axis, each by its own angle."""
    zero = np.zeros_like(angle)
    return se2.compose(np.stack([zero, zero, angle], axis=1), poses)
