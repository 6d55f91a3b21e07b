"""The observation model: what each taxel feels of an object at a pose, and how likely a reading is.

h(q)_i = clip(−σ_k(i)(q⁻¹ p_i) / δ_max, 0, 1); a reading is h, times the taxel's gain error, plus
noise, clipped to 0..1.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


BLOCK = 256  # poses looked up at once: their points stay in the cache


class ObservationModel:
    """h(q) of one scene on one skin, vectorised over poses.

    A pose presses few taxels, so all work beyond finding those few is done on them alone.
    """

    def __init__(self, scene: Scene, layout: Layout, depth_max_m: float) -> None:
        self.scene = scene
        self.layout = layout
        self.depth_max_m = depth_max_m
        ny, nx = scene.silhouette.shape
        self._points = np.vstack([layout.position_m[:, :2].T, np.ones(len(layout))])  # (3, M)
        self._offset = scene.slice_of(layout) * (ny * nx)
        self._flat = scene.slices.ravel()
        inside = scene.slices < 0.0
        near = np.zeros_like(inside)  # cells with a corner inside: elsewhere nothing is felt
        near[:, :-1, :-1] = (
            inside[:, :-1, :-1] | inside[:, :-1, 1:] | inside[:, 1:, :-1] | inside[:, 1:, 1:]
        )
        self._near = near.ravel()

    def felt(self, poses: Floats) -> tuple[NDArray[np.intp], Floats]:
        """The taxels that poses (N, 3) of the object in the sensor frame press: flat indices into
        (N, M), ascending, and their h > 0."""
        if len(poses) <= BLOCK:
            return self._felt(poses)
        blocks = [self._felt(poses[at : at + BLOCK]) for at in range(0, len(poses), BLOCK)]
        step = BLOCK * len(self.layout)
        at = np.concatenate([part[0] + i * step for i, part in enumerate(blocks)])
        return at, np.concatenate([part[1] for part in blocks])

    def _felt(self, poses: Floats) -> tuple[NDArray[np.intp], Floats]:
        scene = self.scene
        ny, nx = scene.silhouette.shape
        c, s = np.cos(poses[:, 2]) / scene.cell, np.sin(poses[:, 2]) / scene.cell
        x, y = poses[:, 0], poses[:, 1]
        x0, y0 = scene.origin / scene.cell
        u = np.stack([c, s, -c * x - s * y - x0], axis=1) @ self._points
        v = np.stack([-s, c, s * x - c * y - y0], axis=1) @ self._points
        np.clip(u, 0.0, nx - 1.001, out=u)
        np.clip(v, 0.0, ny - 1.001, out=v)
        cell = v.astype(np.intp) * nx + u.astype(np.intp) + self._offset
        at = np.flatnonzero(self._near.take(cell))
        u, v, cell = u.ravel()[at] % 1.0, v.ravel()[at] % 1.0, cell.ravel()[at]
        flat = self._flat
        low = flat[cell] * (1.0 - u) + flat[cell + 1] * u
        high = flat[cell + nx] * (1.0 - u) + flat[cell + nx + 1] * u
        depth = -(low * (1.0 - v) + high * v)
        pressed = depth > 0.0
        return at[pressed], np.minimum(depth[pressed] / self.depth_max_m, 1.0)

    def activation(self, poses: Floats) -> Floats:
        """h: poses (N, 3) of the object in the sensor frame → (N, M) in 0..1."""
        h = np.zeros((len(poses), len(self.layout)))
        at, values = self.felt(poses)
        h.flat[at] = values
        return h
