"""The diffusion against closed forms."""

import torch
from torch import Tensor

from taxeld.layout import read as layouts
from taxeld_training.models.base import NetworkConfig
from taxeld_training.models.diffusion import Denoiser, DiffusionSampler
from taxeld_training.models.frames import PoseFrame
from taxeld_training.models.views import Plain

STEPS = 100
SKIN = layouts.load("cylinder:rows=1,columns=4,radius_m=0.04,pitch_m=0.015")


class GaussianDenoiser(Denoiser):
    """The exact v of data N(mean, sd²): E[ε|x] and E[x₀|x] are linear in x."""

    centre, sd = 0.5, 0.3

    def run(self, x: Tensor, shift: Tensor) -> Tensor:
        t = int(shift[0, 0].item())
        a = self.alpha_bar[t]
        variance = a * self.sd**2 + 1.0 - a
        clean = self.centre + a.sqrt() * self.sd**2 / variance * (x - a.sqrt() * self.centre)
        noise = (x - a.sqrt() * clean) / (1.0 - a).sqrt()
        return a.sqrt() * noise - (1.0 - a).sqrt() * clean


def gaussian() -> GaussianDenoiser:
    net = GaussianDenoiser(NetworkConfig(steps=STEPS, width=4), Plain(SKIN), PoseFrame())
    with torch.no_grad():
        net.time.weight.copy_(torch.arange(STEPS)[:, None].expand(-1, 12))
        net.context.weight.zero_()
        net.context.bias.zero_()
    return net


def test_the_sampler_draws_the_gaussian_of_its_denoiser() -> None:
    sampler = DiffusionSampler(gaussian())
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(sampler.noise_steps, 20_000, 4, generator=generator)
    with torch.no_grad():
        drawn = sampler(torch.zeros(1, 4), torch.ones(1, 4), noise)
    assert torch.allclose(drawn.mean(0), torch.full((4,), 0.5), atol=0.01)
    assert torch.allclose(drawn.std(0), torch.full((4,), 0.3), atol=0.02)
