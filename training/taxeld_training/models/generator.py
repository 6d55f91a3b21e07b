"""A one-step generator trained by the energy score: touch and noise to pose in one pass.

The energy score E|A − q| − ½ E|A − A'| of samples A against the true pose q is least for the
posterior itself (Gneiting & Raftery 2007). Training on sets of samples therefore keeps all
modes and needs no teacher. Distances are those in which the quality of samplers is measured.
"""

import torch
from torch import Tensor

from taxeld_training.models.diffusion import PoseNetwork

SET = 16  # samples for each reading in training


class Generator(PoseNetwork):
    """`noise` is (1, S, 4)."""

    family = "generator"
    steps = 1
    length_m = 0.1  # of the object: a radian counts as far as this

    def loss(self, seen: Tensor, angle: Tensor, coordinates: Tensor) -> Tensor:
        code = self.encoder(seen)
        noise = torch.randn(len(seen), SET, 4, device=seen.device)
        shift = self.context(code)[:, None].expand(-1, SET, -1)
        made = self._embed(self.run(noise, shift))
        true = self._embed(self.whitened(coordinates, angle))
        to_true = (made - true[:, None]).norm(dim=-1).mean()
        among = torch.cdist(made, made).sum((1, 2)).mean() / (SET * (SET - 1))
        score: Tensor = to_true - 0.5 * among
        return score

    def forward(self, z: Tensor, live: Tensor, noise: Tensor) -> Tensor:
        """z, live (1, M), noise (1, S, 4) → poses (S, 4): x, y, cos θ, sin θ."""
        code, angle = self.encode(z, live)
        return self.poses(self.run(noise[0], self.context(code)), angle)

    def _embed(self, whitened: Tensor) -> Tensor:
        pose = self.frame.decode(whitened * self.scale + self.mean)
        return torch.cat([pose[..., :2] / self.length_m, pose[..., 2:]], dim=-1)
