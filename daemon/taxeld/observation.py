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

    def log_likelihood(self, z: Floats, live: Bools, h: Floats) -> Floats:
        """log p(z | h) summed over live taxels: z (M,), live (M,), h (N, M) → (N,).

        Each taxel is a mixture of a Gaussian and, with probability `outliers`, a uniform over
        0..1, so a single broken taxel costs a pose a bounded amount.
        """
        variance = self.sigma**2 + (self.gain_cv * h) ** 2
        residual = (z - h) ** 2 / variance
        density = (1.0 - self.outliers) * np.exp(-0.5 * residual) / np.sqrt(2.0 * np.pi * variance)
        terms = np.log(density + self.outliers)
        return np.asarray(terms @ live.astype(np.float64))


class ObservationModel:
    """h(q) of one scene on one skin, vectorised over poses."""

    def __init__(self, scene: Scene, layout: Layout, depth_max_m: float) -> None:
        self.scene = scene
        self.layout = layout
        self.depth_max_m = depth_max_m
        self._x, self._y = layout.position_m[:, 0].copy(), layout.position_m[:, 1].copy()
        self._slice = scene.slice_of(layout)

    def activation(self, poses: Floats) -> Floats:
        """h: poses (N, 3) of the object in the sensor frame → (N, M) in 0..1."""
        c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        dx, dy = self._x - poses[:, :1], self._y - poses[:, 1:2]
        depth = -self.scene.distance(self._slice, c * dx + s * dy, c * dy - s * dx)
        return np.clip(depth / self.depth_max_m, 0.0, 1.0)
