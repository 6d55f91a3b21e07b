"""Proposals that are computed from the scene, without training."""

from collections.abc import Callable, Iterator

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.errors import SetupError
from taxeld.model import contacts, se2
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel

ROUNDS = 1000  # most rounds of drawing contacts; `check_contacts` has found that some land
DRAWS, LEAST_FELT = 5000, 10  # contacts drawn by `check_contacts`, and the fewest that must be felt
NUMBERS = 8_000_000  # of a table, at most: 32 MB; a skin of 800 taxels has all contacts
NO_CONTACT = "scene: no contact with this skin can be made; build the bundle again"


def _contacts(model: ObservationModel, n: int, rng: np.random.Generator) -> Iterator[Poses]:
    """Rounds of contact poses, of `n` draws each."""
    for _ in range(ROUNDS):
        yield contacts.synthesise(
            model.scene, model.layout.radius_m, model.depth_max_m, n, rng
        ).pose


def check_contacts(model: ObservationModel) -> None:
    """Check that contacts can be drawn: otherwise drawing them would never end.

    Raises:
        SetupError: hardly any land on the object, or are felt.
    """
    felt, _ = model.pressed(next(_contacts(model, DRAWS, np.random.default_rng(0))))
    if len(np.unique(felt // len(model.layout))) < LEAST_FELT:
        raise SetupError(NO_CONTACT)


class Projection:
    """The paper's uninformed baseline: contact poses that ignore the activations."""

    name = "projection"

    def __init__(self, model: ObservationModel) -> None:
        self._model = model

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        """z (M,), live (M,) → contact poses (n, 3), whatever the activations."""
        found = np.empty((0, 3))
        for poses in _contacts(self._model, 2 * n + 8, rng):
            found = np.concatenate([found, poses])
            if len(found) >= n:
                break
        return found[:n]


class Manifold:
    """A point of the outline, turned to face the touched side, as deep as the strongest taxel.

    Exact for a smooth convex outline, but for its curvature; all points of the outline weigh alike.
    """

    name = "manifold"

    def __init__(self, model: ObservationModel) -> None:
        self._model = model
        outline = model.scene.outline
        ahead, behind = np.roll(outline, -1, axis=0), np.roll(outline, 1, axis=0)
        tangent = ahead - behind
        area = np.sum(outline[:, 0] * ahead[:, 1] - ahead[:, 0] * outline[:, 1])
        outwards = -np.pi / 2 if area > 0 else np.pi / 2  # tangent → normal
        self._facing = np.arctan2(tangent[:, 1], tangent[:, 0]) + outwards

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """z (M,), live (M,) → object poses (n, 3) in the sensor frame."""
        model = self._model
        scene, radius_m = model.scene, model.layout.radius_m
        pressed = np.where(live, z, 0.0)
        at = pressed @ model.layout.position_m[:, :2]
        touched = np.arctan2(at[1], at[0])
        depth_m = float(pressed.max()) * model.depth_max_m
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
    """The nearest of `size` simulated contacts, by their activations.

    On a layout with rotation symmetry, contacts are stored turned to their strongest taxel, and
    activations are looked up in the same way.
    """

    name = "table"

    def __init__(self, model: ObservationModel, size: int = 10_000, seed: int = 0) -> None:
        layout = model.layout
        rng = np.random.default_rng(seed)
        self._layout = layout
        size = min(size, NUMBERS // len(layout))
        h, poses = np.empty((0, len(layout)), np.float32), np.empty((0, 3))
        for made in _contacts(model, size, rng):
            found = np.zeros((len(made), len(layout)), np.float32)
            at, depth = model.pressed(made)
            found.flat[at] = depth
            kept = np.flatnonzero(found.max(axis=1) > 0.0)[: size - len(h)]
            h, poses = np.concatenate([h, found[kept]]), np.concatenate([poses, made[kept]])
            if len(h) == size:
                break
        else:
            raise SetupError(NO_CONTACT)
        turn = layout.sector[h.argmax(axis=1)]
        for row, k in zip(h, turn, strict=True):
            row[:] = row[layout.turns[k]]
        self._h, self._square = h, np.square(h)
        self._pose = _turned(poses, -2.0 * np.pi * turn / len(layout.turns))

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        """z (M,), live (M,) → object poses (n, 3) in the sensor frame."""
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


ANALYTIC: dict[str, Callable[[ObservationModel], Proposal]] = {
    "projection": Projection,
    "manifold": Manifold,
    "table": Table,
}
