"""Simulated touches: contact poses with their true activations, and batches of readings of them."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from taxeld.contacts import synthesise
from taxeld.errors import SetupError
from taxeld.observation import Noise, ObservationModel

FELT = 0.05  # a touch whose strongest taxel stays below this is not felt and never asked about
DEAD_SHARE = 0.3  # of training touches have dead taxels
DEAD_MAX = 0.3  # of a skin's taxels are dead at most


@dataclass(frozen=True)
class Touches:
    """n felt contacts: poses (n, 3) in the sensor frame, activations h (n, M) without noise."""

    pose: NDArray[np.float64]
    activation: NDArray[np.float32]
    dropped_share: float  # of uniform poses whose projection missed the manifold

    def __len__(self) -> int:
        return len(self.pose)


def simulate(model: ObservationModel, n: int, rng: np.random.Generator) -> Touches:
    """`n` felt contacts under the prior of single-step projection.

    Raises:
        SetupError: the skin hardly ever feels the object.
    """
    poses, activations = [], []
    felt = drawn = dropped = 0
    while felt < n:
        contacts = synthesise(model.scene, model.layout.radius_m, model.depth_max_m, 20_000, rng)
        h = model.activation(contacts.pose)
        keep = h.max(axis=1) > FELT
        poses.append(contacts.pose[keep])
        activations.append(h[keep].astype(np.float32))
        felt, drawn, dropped = felt + int(keep.sum()), drawn + 20_000, dropped + contacts.dropped
        if drawn >= 400_000 and felt < drawn // 100:
            raise SetupError("fewer than 1 % of contacts are felt; the skin misses the object")
    return Touches(np.concatenate(poses)[:n], np.concatenate(activations)[:n], dropped / drawn)


class Batches:
    """Batches of noisy, turned readings with their whitened poses, drawn with replacement."""

    def __init__(self, touches: Touches, model: ObservationModel, noise: Noise, seed: int) -> None:
        layout = model.layout
        self.noise = noise
        self.activation = torch.from_numpy(touches.activation)
        self.pose = torch.from_numpy(touches.pose).float()
        self.turns = torch.from_numpy(layout.turns)
        self.sector = torch.from_numpy(layout.sector)
        self.generator = torch.Generator().manual_seed(seed)
        sample = self.draw(20_000)[2]
        self.mean, self.scale = sample.mean(0), sample.std(0).clamp(min=1e-3)

    def draw(self, n: int) -> tuple[Tensor, Tensor, Tensor]:
        """`read` of n contacts, drawn with replacement."""
        return self.read(torch.randint(len(self.pose), (n,), generator=self.generator))

    def read(self, i: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """z (n, M), live (n, M) and poses (n, 4) of contacts i, turned to the strongest taxel's
        sector; their noise and dead taxels are drawn anew each time."""
        g = self.generator
        h = self.activation[i]
        gain = 1.0 + self.noise.gain_cv * torch.randn(h.shape, generator=g)
        z = gain * h + self.noise.sigma * torch.randn(h.shape, generator=g)
        live = self._live(h)
        z = z.clamp(0.0, 1.0) * live
        turn = self.sector[z.argmax(dim=1)]
        taxels = self.turns[turn]
        angle = -2.0 * torch.pi * turn / len(self.turns)
        return z.gather(1, taxels), live.gather(1, taxels), _turned(self.pose[i], angle)

    def _live(self, h: Tensor) -> Tensor:
        g = self.generator
        share = torch.rand((len(h), 1), generator=g) * (DEAD_MAX / DEAD_SHARE)
        share = (share - (DEAD_MAX / DEAD_SHARE - DEAD_MAX)).clamp(min=0.0)
        live = (torch.rand(h.shape, generator=g) >= share).float()
        unfelt = (h * live).amax(dim=1, keepdim=True) < FELT
        return torch.where(unfelt, 1.0, live)


def _turned(pose: Tensor, angle: Tensor) -> Tensor:
    c, s = torch.cos(angle), torch.sin(angle)
    theta = pose[:, 2] + angle
    x = c * pose[:, 0] - s * pose[:, 1]
    y = s * pose[:, 0] + c * pose[:, 1]
    return torch.stack([x, y, torch.cos(theta), torch.sin(theta)], dim=1)
