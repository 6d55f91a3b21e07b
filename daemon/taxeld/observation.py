"""The observation model: what each taxel feels of an object at a pose, and how likely a reading is.

h(q)_i = clip(−σ_k(i)(q⁻¹ p_i) / δ_max, 0, 1); a reading is h, times the taxel's gain error, plus
noise, clipped to 0..1.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.contacts import axis_in_object
from taxeld.layout import Layout
from taxeld.scene import Scene

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Noise:
    """Errors of a reading z around h(q); dimensionless, as activations are."""

    sigma: float = 0.02  # sd of the additive noise
    gain_cv: float = 0.17  # sd of a taxel's relative gain error (PROTOCOL: measured on such skin)
    outliers: float = 0.01  # probability that a reading has nothing to do with the pose

    def draw(self, h: Floats, rng: np.random.Generator) -> Floats:
        """Readings of true activations `h` (any shape)."""
        gain = 1.0 + self.gain_cv * rng.standard_normal(h.shape)
        return np.clip(gain * h + self.sigma * rng.standard_normal(h.shape), 0.0, 1.0)

    def log_density(self, z: Floats, h: Floats) -> Floats:
        """log p(z | h) of each taxel; shapes broadcast.

        A mixture of a Gaussian and, with probability `outliers`, a uniform over 0..1, so a single
        broken taxel costs a pose a bounded amount.
        """
        variance = self.sigma**2 + (self.gain_cv * h) ** 2
        gauss = np.exp(-0.5 * (z - h) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
        return np.asarray(np.log((1.0 - self.outliers) * gauss + self.outliers))

    def log_likelihood(self, z: Floats, live: Bools, h: Floats) -> Floats:
        """log p(z | h) summed over live taxels: z (M,), live (M,), h (N, M) → (N,)."""
        return np.asarray(self.log_density(z, h) @ live.astype(np.float64))


BLOCK = 65_536  # points looked up at once: they stay in the cache


class ObservationModel:
    """h(q) of one scene on one skin, vectorised over poses.

    A pose presses few taxels, so all work beyond finding those few is done on them alone.
    """

    def __init__(self, scene: Scene, layout: Layout, depth_max_m: float) -> None:
        self.scene = scene
        self.layout = layout
        self.depth_max_m = depth_max_m
        ny, nx = scene.silhouette.shape
        place, group = np.unique(layout.position_m[:, :2], axis=0, return_inverse=True)
        self._places = np.vstack([place.T, np.ones(len(place))])  # (3, P): taxels stand in columns
        self._column = _padded(group, len(place))  # (P, most) taxels there
        self._offset = scene.slice_of(layout)[self._column] * (ny * nx)
        self._flat = scene.slices.ravel()
        inside = scene.silhouette < 0.0
        near = np.zeros_like(inside)  # cells with a corner inside: elsewhere nothing is felt
        near[:-1, :-1] = inside[:-1, :-1] | inside[:-1, 1:] | inside[1:, :-1] | inside[1:, 1:]
        self._near = near.ravel()
        farthest = float(np.hypot(*place.T).max()) + 1.5 * scene.cell
        self._reach = (scene.silhouette < farthest).ravel()

    def felt(self, poses: Floats) -> tuple[NDArray[np.intp], Floats]:
        """The taxels that poses (N, 3) of the object in the sensor frame press: flat indices into
        (N, M) and their h > 0."""
        size = max(BLOCK // len(self._column), 1)
        if len(poses) <= size:
            return self._felt(poses)
        blocks = [self._felt(poses[at : at + size]) for at in range(0, len(poses), size)]
        step = size * len(self.layout)
        at = np.concatenate([part[0] + i * step for i, part in enumerate(blocks)])
        return at, np.concatenate([part[1] for part in blocks])

    def _felt(self, poses: Floats) -> tuple[NDArray[np.intp], Floats]:
        """`felt` of the poses that the link reaches: the others press nothing."""
        reached = np.flatnonzero(self._reached(poses))
        if len(reached) == len(poses):
            return self._pressed(poses)
        at, h = self._pressed(poses[reached])
        row, taxel = np.divmod(at, len(self.layout))
        return reached[row] * len(self.layout) + taxel, h

    def _reached(self, poses: Floats) -> NDArray[np.bool_]:
        """(N,) whether the link's cylinder may touch the object: one look at the silhouette."""
        scene = self.scene
        ny, nx = scene.silhouette.shape
        x, y = axis_in_object(poses)
        u = np.clip((x - scene.origin[0]) / scene.cell, 0.0, nx - 1.0)
        v = np.clip((y - scene.origin[1]) / scene.cell, 0.0, ny - 1.0)
        return np.asarray(self._reach.take(v.astype(np.intp) * nx + u.astype(np.intp)))

    def _pressed(self, poses: Floats) -> tuple[NDArray[np.intp], Floats]:
        scene = self.scene
        ny, nx = scene.silhouette.shape
        c, s = np.cos(poses[:, 2]) / scene.cell, np.sin(poses[:, 2]) / scene.cell
        x, y = poses[:, 0], poses[:, 1]
        x0, y0 = scene.origin / scene.cell
        u = np.stack([c, s, -c * x - s * y - x0], axis=1) @ self._places
        v = np.stack([-s, c, s * x - c * y - y0], axis=1) @ self._places
        np.clip(u, 0.0, nx - 1.001, out=u)
        np.clip(v, 0.0, ny - 1.001, out=v)
        cell = v.astype(np.intp) * nx + u.astype(np.intp)
        at = np.flatnonzero(self._near.take(cell))
        row, place = np.divmod(at, cell.shape[1])
        u, v, cell = u.take(at)[:, None], v.take(at)[:, None], cell.take(at)[:, None]
        u -= np.floor(u)
        v -= np.floor(v)
        cell = cell + self._offset.take(place, axis=0)
        flat = self._flat
        low = flat.take(cell) * (1.0 - u) + flat.take(cell + 1) * u
        high = flat.take(cell + nx) * (1.0 - u) + flat.take(cell + nx + 1) * u
        depth = -(low * (1.0 - v) + high * v)
        taxel = self._column.take(place, axis=0)
        pressed = np.flatnonzero((depth > 0.0) & (taxel >= 0))
        h = np.minimum(depth.take(pressed) / self.depth_max_m, 1.0)
        return row.take(pressed // taxel.shape[1]) * len(self.layout) + taxel.take(pressed), h

    def activation(self, poses: Floats) -> Floats:
        """h: poses (N, 3) of the object in the sensor frame → (N, M) in 0..1."""
        h = np.zeros((len(poses), len(self.layout)))
        at, values = self.felt(poses)
        h.flat[at] = values
        return h


def _padded(group: NDArray[np.intp], groups: int) -> NDArray[np.intp]:
    """(groups, most) the members of each group, −1 where it has fewer than the largest."""
    count = np.bincount(group, minlength=groups)
    members = np.full((groups, int(count.max())), -1)
    order = np.argsort(group, kind="stable")
    members[group[order], np.arange(len(group)) - (np.cumsum(count) - count)[group[order]]] = order
    return members
