"""Simulated touches: contact poses with their true activations, and readings of them as a filter
sees them, 0 under a floor."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from taxeld.errors import SetupError
from taxeld.model.activation import FLOOR
from taxeld.model.contacts import synthesise
from taxeld.model.observation import Noise, ObservationModel

MIN_ACTIVATION = 0.05  # of the strongest taxel: weaker contacts are neither learned nor sampled
SILENT = 5.0  # standard deviations of noise under which a reading is 0: noise is no touch
FLOOR_MAX = 0.12  # in training the floor is anything from FLOOR to this: skins and places differ
DEAD_SHARE = 0.3  # of training touches have dead taxels
DEAD_MAX = 0.3  # of a skin's taxels are dead at most


@dataclass(frozen=True)
class Touches:
    """n contacts: poses (n, 3) in the sensor frame, activations h (n, M) without noise."""

    pose: NDArray[np.float64]
    activation: NDArray[np.float32]
    dropped_share: float  # of uniform poses whose projection missed the manifold

    def __len__(self) -> int:
        return len(self.pose)


def simulate(model: ObservationModel, n: int, rng: np.random.Generator) -> Touches:
    """`n` contacts under the prior of single-step projection, each with a taxel over
    MIN_ACTIVATION.

    Raises:
        SetupError: hardly any contact presses a taxel.
    """
    poses, activations = [], []
    kept = drawn = dropped = 0
    while kept < n:
        contacts = synthesise(model.scene, model.layout.radius_m, model.depth_max_m, 20_000, rng)
        h = model.activation(contacts.pose)
        keep = h.max(axis=1) > MIN_ACTIVATION
        poses.append(contacts.pose[keep])
        activations.append(h[keep].astype(np.float32))
        kept, drawn, dropped = kept + int(keep.sum()), drawn + 20_000, dropped + contacts.dropped
        if drawn >= 400_000 and kept < drawn // 100:
            raise SetupError("fewer than 1 % of contacts are felt; the skin misses the object")
    return Touches(np.concatenate(poses)[:n], np.concatenate(activations)[:n], dropped / drawn)


@dataclass(frozen=True)
class Readings:
    """n readings: poses (n, 3) in the sensor frame, z (n, M), live (n, M), the floor of all."""

    pose: NDArray[np.float64]
    z: NDArray[np.float64]
    live: NDArray[np.bool_]
    floor: float

    def __len__(self) -> int:
        return len(self.pose)


def floor_of(noise: Noise) -> float:
    """Of full scale, under which a skin with such noise reports 0."""
    return max(FLOOR, SILENT * noise.sigma)


def read(
    model: ObservationModel, noise: Noise, n: int, rng: np.random.Generator, dead: float = 0.0
) -> Readings:
    """`n` simulated contacts as a filter sees them: each is felt by a live taxel at least. A share
    `dead` of the taxels is dead in each."""
    floor, found = floor_of(noise), 0
    parts = []
    while found < n:
        touches = simulate(model, n, rng)
        z = noise.draw(touches.activation.astype(np.float64), rng)
        live = rng.random(z.shape) >= dead
        z = np.where(live & (z >= floor), z, 0.0)
        felt = z.any(axis=1)
        found += int(felt.sum())
        parts.append((touches.pose[felt], z[felt], live[felt]))
    pose, z, live = (np.concatenate(part)[:n] for part in zip(*parts, strict=True))
    return Readings(pose, z, live, floor)


class Batches:
    """Batches of noisy readings with the coordinates of their poses, drawn with replacement."""

    def __init__(
        self, touches: Touches, coordinates: Tensor, noise: Noise, seed: int, device: torch.device
    ) -> None:
        self.noise = noise
        self.activation = torch.from_numpy(touches.activation).to(device)
        self.coordinates = coordinates.to(device)  # (n, 3) of touches.pose
        self.generator = torch.Generator(device).manual_seed(seed)

    def draw(self, n: int) -> tuple[Tensor, Tensor, Tensor]:
        """z (n, M), live (n, M) and coordinates (n, 3)."""
        g, device = self.generator, self.activation.device
        return self.read(torch.randint(len(self.coordinates), (n,), generator=g, device=device))

    def read(self, i: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The same of chosen contacts, indices (n,)."""
        g, device = self.generator, self.activation.device
        h = self.activation[i]
        gain = 1.0 + self.noise.gain_cv * torch.randn(h.shape, generator=g, device=device)
        z = gain * h + self.noise.sigma * torch.randn(h.shape, generator=g, device=device)
        live = self._live(h)
        return self._over_floor(z * live).clamp(0.0, 1.0), live, self.coordinates[i]

    def _over_floor(self, z: Tensor) -> Tensor:
        """z (n, M), 0 where it is under a floor of each reading's own; the least of floors where
        nothing would be felt."""
        g, device = self.generator, z.device
        floor = torch.rand((len(z), 1), generator=g, device=device) * (FLOOR_MAX - FLOOR) + FLOOR
        floor = torch.where(z.amax(dim=1, keepdim=True) >= floor, floor, FLOOR)
        return torch.where(z >= floor, z, 0.0)

    def _live(self, h: Tensor) -> Tensor:
        """live (n, M): dead taxels in DEAD_SHARE of the touches, uniformly 0..DEAD_MAX of the skin;
        none where no live taxel would be pressed."""
        g, device = self.generator, h.device
        share = torch.rand((len(h), 1), generator=g, device=device) * (DEAD_MAX / DEAD_SHARE)
        share = (share - (DEAD_MAX / DEAD_SHARE - DEAD_MAX)).clamp(min=0.0)
        live = (torch.rand(h.shape, generator=g, device=device) >= share).float()
        silent = (h * live).amax(dim=1, keepdim=True) < MIN_ACTIVATION
        return torch.where(silent, 1.0, live)
